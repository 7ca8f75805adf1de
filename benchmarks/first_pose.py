"""Seconds from the start of `stereo-sfm run` to its first poses, first without compiled kernels, then with them.

    python -m benchmarks first_pose -- [SOURCE] [--repeat N]

Each repetition begins with an empty folder for compiled kernels. Printed are wall time and processor time of all
processes until the first frame with a pose (which defines the odometry frame) and until the next one (the first that
is tracked). The exit code is 1 if the first pose without compiled kernels takes more than 15 s in the median. The
machine should be quiet: the load is printed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import psutil

LIMIT_S = 15.0
FRAMES = 20
NOTED = "FIRST_POSES"  # environment: the file for the times of the first poses


def processor_s() -> float:
    """Of this process and all that it has started, those that have ended included."""
    total = 0.0
    for process in (psutil.Process(), *psutil.Process().children(recursive=True)):
        times = process.cpu_times()
        total += times.user + times.system + times.children_user + times.children_system
    return total


def run(arguments: list[str], noted: Path) -> int:
    """`stereo-sfm run` in this process; notes when it gets the first poses."""
    from stereo_sfm.cli import main
    from stereo_sfm.pipeline.session import Session
    from stereo_sfm.types import Frame, TrackState

    frames, times = Session.__iter__, list[tuple[float, float]]()

    def watched(session: Session) -> Iterator[Frame]:
        for frame in frames(session):
            if frame.state == TrackState.OK and len(times) < 2:
                times.append((time.time(), processor_s()))
                noted.write_text(json.dumps(times))
            yield frame

    Session.__iter__ = watched
    return main(["run", *arguments])


def measure(source: str, kernels: Path, folder: Path) -> list[tuple[float, float]]:
    """Wall and processor seconds until each of the first two poses."""
    noted = folder / "times.json"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(kernels), NOTED: str(noted)}
    arguments = [*([source] if source else []), "--quiet", "--max-frames", str(FRAMES), "-o", str(folder / "run")]
    begin = time.time()
    subprocess.run([sys.executable, __file__, *arguments], env=environment, check=True, stdout=subprocess.DEVNULL)
    return [(at - begin, used) for at, used in json.loads(noted.read_text())]


def main() -> int:
    """Print a row for each run; 1 if a first run takes too long."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default="")
    parser.add_argument("--repeat", type=int, default=1)
    args = parser.parse_args()
    first = list[float]()
    for _ in range(args.repeat):
        with tempfile.TemporaryDirectory() as name:
            for kind in ("nothing compiled", "compiled"):
                folder = Path(name) / kind
                folder.mkdir()
                (wall_s, used_s), (next_wall_s, next_used_s) = measure(args.source, Path(name) / "kernels", folder)
                print(
                    f"{kind:17s} first pose {wall_s:5.1f} s ({used_s:5.1f} s of processor time), "
                    f"next {next_wall_s:5.1f} s ({next_used_s:5.1f} s), load {os.getloadavg()[0]:.1f}",
                    flush=True,
                )
                if kind == "nothing compiled":
                    first.append(wall_s)
    return int(float(np.median(first)) > LIMIT_S)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:], Path(os.environ[NOTED])) if NOTED in os.environ else main())
