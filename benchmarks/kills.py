"""Stages of a running service are killed one after another: how long until the next pose, and what recordings lose.

    python -m benchmarks kills -- [--count 100] [--busy N] [--stages tracker,mapper]

The service plays the bundled recording again and again at its rate. Printed are the seconds from each kill to the next
pose, their median and largest, how many took at most 3 s, how long SIGTERM's work took at the end, and seconds that the
recordings lack. `--busy` starts that many loops beside it. The exit code is 1 if more than 5 % took longer.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stereo_sfm.service.messages import PoseUpdate
    from stereo_sfm.service.service import Service
# What a file that is run imports at its top, every process that it starts imports again: `serve` imports nothing there.

DEMO = Path(__file__).parents[1] / "recordings" / "demo.mcap"
STAGES = "capture", "tracker", "mapper", "loop", "optimizer"
WITHIN_S, SHARE = 3.0, 0.95
STEADY, STEADY_S = 30, 10.0  # poses and seconds of a session before its kill
GIVE_UP_S = 120.0


class Poses:
    """The newest pose, and when it came."""

    def __init__(self) -> None:
        self.came = threading.Condition()
        self.count, self.session, self.frame = 0, 0, -1
        self.frames: set[tuple[int, int]] = set()

    def put(self, pose: PoseUpdate) -> None:
        with self.came:
            self.count += 1
            self.session = pose.session
            self.frames.add((pose.session, pose.frame_id))
            self.came.notify_all()

    def more(self, count: int) -> bool:
        """Wait for so many more; False when they do not come."""
        until = self.count + count
        with self.came:
            return self.came.wait_for(lambda: self.count >= until, GIVE_UP_S)


def logged(root: Path) -> list[set[int]]:
    """Frames in each recording, oldest first."""
    from stereo_sfm.log import topics
    from stereo_sfm.log.reader import LogReader
    from stereo_sfm.recording.segments import recordings, segments

    out: list[set[int]] = []
    for folder in recordings(root):
        out.append(set())
        for segment in segments(folder):
            with LogReader(segment.poses) as reader:
                out[-1] |= {record.sequence for record in reader.messages([topics.FRAME])}
    return out


def killed(service: Service, poses: Poses, stage: str) -> float:
    """Kill a stage; seconds to the next pose of another session, or of the same one where that goes on."""
    poses.more(STEADY)
    time.sleep(STEADY_S)
    while (pid := service.pids.get(stage)) is None:  # the pipeline was started again meanwhile
        poses.more(STEADY)
    session = poses.session
    began = time.monotonic()
    os.kill(pid, signal.SIGKILL)
    with poses.came:
        ended = poses.came.wait_for(lambda: poses.session > session or service.pids.get(stage) not in (None, pid), 30.0)
        if not ended:
            return float("inf")
        if poses.session == session:  # a loop closer's death costs no session
            poses.came.wait(GIVE_UP_S)
    return time.monotonic() - began


def main(args: list[str] | None = None) -> int:
    from stereo_sfm.service.config import MapConfig, RecordingConfig, RobotConfig, SourceConfig
    from stereo_sfm.service.messages import PoseUpdate
    from stereo_sfm.service.service import Service

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100, metavar="N")
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="busy loops beside it")
    parser.add_argument("--stages", default=",".join(STAGES), help="in turn")
    o = parser.parse_args(args)
    with tempfile.TemporaryDirectory() as place, ExitStack() as beside:
        root = Path(place) / "recordings"
        config = RobotConfig(
            source=SourceConfig(str(DEMO), repeat=True), map=MapConfig(str(Path(place) / "store"), save_every_min=0.2),
            recording=RecordingConfig(str(root), "lean"),
        )  # fmt: skip
        poses, took = Poses(), list[float]()
        with Service(config) as service:
            service.on(PoseUpdate, poses.put)
            poses.more(1)
            for _ in range(o.busy):
                loop = subprocess.Popen([sys.executable, "-c", "while True: pass"])
                beside.callback(loop.kill)
            for _, stage in zip(range(o.count), itertools.cycle(o.stages.split(",")), strict=False):
                took.append(killed(service, poses, stage))
                print(f"  {stage:10s} {took[-1]:6.2f} s", flush=True)
            began = time.monotonic()
        ended_s = time.monotonic() - began
        found, seen = logged(root), [{f for s, f in poses.frames if s == n} for n in range(1, poses.session + 1)]
        saved = (Path(place) / "store" / "map.json").exists()
    lost = sum(len(a - b) for a, b in zip(seen, found, strict=False))
    good = sum(s <= WITHIN_S for s in took)
    print(f"load {os.getloadavg()[0]:.1f}; {good} of {len(took)} within {WITHIN_S:g} s, "
          f"median {statistics.median(took):.2f} s, the longest {max(took):.2f} s; ended in {ended_s:.1f} s, "
          f"map saved: {saved}; {lost} of {len(poses.frames)} poses are not in the recordings")  # fmt: skip
    return int(good < SHARE * len(took))


if __name__ == "__main__":
    sys.exit(main())
