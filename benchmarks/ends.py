"""SIGTERM to a running service beside busy loops, again and again: how long until it has ended, and is the map saved.

    python -m benchmarks ends -- [--count 50] [--busy 8] [--seconds 5] [--continued 2]

Each service plays the bundled recording with page, Foxglove and pose socket on, and records. It gets the signal some
seconds after its first pose. A map is continued by so many services after the one that began it: the sessions in the
saved map are counted, too. The exit code is the number of ends that took longer than 5 s or left a session out.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.attack import STOP_S, Target, running
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps.saved_map import load_map


def end(target: Target) -> tuple[float, int, int, int]:
    """Seconds from SIGTERM to the exit, exit code, keyframes and sessions of the saved map."""
    begin = time.monotonic()
    target.process.send_signal(signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        target.process.wait(4 * STOP_S)
    seconds = time.monotonic() - begin
    try:
        saved = load_map(target.folder / "store")
        return seconds, target.process.returncode, len(saved), len(saved.session_ids)
    except StereoSfmError:
        return seconds, target.process.returncode, 0, 0


def main(args: list[str] | None = None) -> int:
    """Print each end and the sum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=50, metavar="N")
    parser.add_argument("--busy", type=int, default=8, metavar="N", help="busy loops beside it")
    parser.add_argument("--seconds", type=float, default=5.0, help="from the first pose to the first signal; then more")
    parser.add_argument("--continued", type=int, default=2, metavar="N", help="services that continue each map")
    o = parser.parse_args(args)
    took, good = list[float](), 0
    with ExitStack() as beside, tempfile.TemporaryDirectory(prefix="ends") as place:
        loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(o.busy)]
        for loop in loops:
            beside.callback(loop.kill)
        for k in range(o.count):
            for loop in loops:
                loop.send_signal(signal.SIGSTOP)  # while the next one starts
            number, before = divmod(k, 1 + o.continued)
            with running(0, Path(place) / str(number)) as target:
                for loop in loops:
                    loop.send_signal(signal.SIGCONT)
                time.sleep(o.seconds * (1 + k % 3))
                seconds, code, keyframes, sessions = end(target)
            took.append(seconds)
            fine = seconds <= STOP_S and code == 0 and sessions == 1 + before
            good += fine
            last = (target.said.strip().splitlines()[-1:] or [""])[0][:100]
            print(
                f"  {seconds:5.2f} s, exit code {code}, {keyframes} keyframes of {sessions} sessions  "
                f"{last if fine else target.said}",
                flush=True,
            )
    print(f"load {os.getloadavg()[0]:.1f}; {good} of {o.count} within {STOP_S:g} s with every session in the map, "
          f"median {statistics.median(took):.2f} s, the longest {max(took):.2f} s")  # fmt: skip
    return o.count - good


if __name__ == "__main__":
    sys.exit(main())
