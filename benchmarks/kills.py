"""Stages of a running service are killed one after another: how long until the next pose, and what recordings lose.

    python -m benchmarks kills -- [--count 100] [--busy N] [--stages tracker,mapper]

The service plays the bundled recording again and again at its rate. Printed are the seconds from each kill to the next
pose, their median and largest, how many took at most 3 s, how long SIGTERM's work took at the end, and the poses and
images that the recordings lack. `--busy` starts that many loops; a fifth as many stages, one at least, are killed
before that, for the figure of the quiet machine. Where a kill costs no session, as a loop closer's does, poses go on
meanwhile: its seconds are those to the next pose after the stage runs again, and the others are counted alone, too.

The exit code is 1 if more than 5 % took longer beside the loops (without `--busy`: at all), if a pose or its image is
not in the recordings that came more than a second before or after a kill, or if no map was saved.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stereo_sfm.service.messages import PoseUpdate
    from stereo_sfm.service.service import Service
# What a file that is run imports at its top, every process that it starts imports again: `serve` imports nothing there.

DEMO = Path(__file__).parents[1] / "recordings" / "demo.mcap"
STAGES = "capture", "tracker", "mapper", "loop", "optimizer"
WITHIN_S, SHARE = 3.0, 0.95
QUIET = 0.2  # of the kills beside busy loops: as many more come before them
AROUND_S = 1.0  # before and after a kill: a pose of that time may be missing in the recordings
STEADY, STEADY_S = 30, 10.0  # poses and seconds of a session before its kill
GIVE_UP_S = 120.0


@dataclass(frozen=True)
class Kill:
    """What a kill cost."""

    stage: str
    at_s: float  # monotonic time
    took_s: float  # until the next pose
    session_lost: bool  # another session began


class Poses:
    """Which poses came, and when."""

    def __init__(self) -> None:
        self.came = threading.Condition()
        self.count, self.session = 0, 0
        self.at_s: dict[tuple[int, int], float] = {}  # (session, frame) -> monotonic time

    def put(self, pose: PoseUpdate) -> None:
        with self.came:
            self.count += 1
            self.session = pose.session
            self.at_s[pose.session, pose.frame_id] = time.monotonic()
            self.came.notify_all()

    def more(self, count: int) -> bool:
        """Wait for so many more; False when they do not come."""
        until = self.count + count
        with self.came:
            return self.came.wait_for(lambda: self.count >= until, GIVE_UP_S)


def logged(root: Path, topic: str) -> list[tuple[float, set[int]]]:
    """Of each recording with a topic: the monotonic time at which its middle message was written, and its frames."""
    from stereo_sfm.log.reader import LogReader
    from stereo_sfm.recording.segments import recordings, segments

    out, began_ns = list[tuple[float, set[int]]](), time.time_ns() - time.monotonic_ns()
    for folder in recordings(root):
        written = list[tuple[int, int]]()
        for path in (path for s in segments(folder) for path in (s.poses, s.images) if path.exists()):
            with LogReader(path) as reader:
                written += [(record.publish_time, record.sequence) for record in reader.messages([topic])]
        if written:
            middle_ns = statistics.median(ns for ns, _ in written)
            out.append(((middle_ns - began_ns) / 1e9, {frame for _, frame in written}))
    return out


def missing(poses: Mapping[tuple[int, int], float], found: Sequence[tuple[float, set[int]]]) -> list[float]:
    """When the poses came whose frames no recording of their session has; a recording is of the newest of its time."""
    begins: dict[int, float] = {}
    for (session, _), at_s in poses.items():
        begins[session] = min(at_s, begins.get(session, at_s))
    recorded: dict[int, set[int]] = {session: set() for session in begins}
    for at_s, frames in found:
        before = [session for session in begins if begins[session] <= at_s]
        recorded[max(before, default=min(begins))] |= frames
    return [at_s for (session, frame), at_s in poses.items() if frame not in recorded[session]]


def beyond(lost: Sequence[float], kills: Sequence[Kill]) -> int:
    """How many of the missing poses came at another time than that of a kill."""
    return sum(all(abs(at_s - kill.at_s) > AROUND_S for kill in kills) for at_s in lost)


def killed(service: Service, poses: Poses, stage: str) -> Kill:
    """Kill a stage, until the next pose of another session, or of the same one where that goes on."""
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
            return Kill(stage, began, float("inf"), True)
        if poses.session == session:  # a loop closer's death costs no session
            poses.came.wait(GIVE_UP_S)
        return Kill(stage, began, time.monotonic() - began, poses.session > session)


def kill_stages(service: Service, poses: Poses, stages: Sequence[str], count: int) -> list[Kill]:
    """So many kills, of the stages in turn."""
    kills = list[Kill]()
    for _, stage in zip(range(count), itertools.cycle(stages), strict=False):
        kills.append(kill := killed(service, poses, stage))
        print(f"  {stage:10s} {kill.took_s:6.2f} s{'' if kill.session_lost else ', no session lost'}", flush=True)
    return kills


def good(kills: Sequence[Kill]) -> int:
    """How many were followed by a pose in time."""
    return sum(kill.took_s <= WITHIN_S for kill in kills)


def summary(name: str, kills: Sequence[Kill]) -> str:
    """Of all kills, and of those that cost a session."""
    took, costly = [kill.took_s for kill in kills], [kill for kill in kills if kill.session_lost]
    free = sorted({kill.stage for kill in kills if not kill.session_lost})
    told = f"; {len(kills) - len(costly)} cost no session ({', '.join(free)}), " if free else ""
    told += f"of the other {len(costly)}: {good(costly)}" if free else ""
    return (f"{name}: {good(kills)} of {len(kills)} within {WITHIN_S:g} s, median {statistics.median(took):.2f} s, "
            f"the longest {max(took):.2f} s{told}")  # fmt: skip


def main(args: list[str] | None = None) -> int:
    from stereo_sfm.log import topics
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
            recording=RecordingConfig(str(root), "full"),
        )  # fmt: skip
        poses, quiet, stages = Poses(), list[Kill](), o.stages.split(",")
        with Service(config) as service:
            service.on(PoseUpdate, poses.put)
            poses.more(1)
            if o.busy:
                quiet = kill_stages(service, poses, stages, math.ceil(QUIET * o.count))
            for _ in range(o.busy):
                loop = subprocess.Popen([sys.executable, "-c", "while True: pass"])
                beside.callback(loop.kill)
            kills = kill_stages(service, poses, stages, o.count)
            began = time.monotonic()
        ended_s = time.monotonic() - began
        lost = missing(poses.at_s, logged(root, topics.FRAME))
        told = logged(root, topics.DROPPED)
        unseen = missing(poses.at_s, logged(root, topics.LEFT_IMAGE) + told)
        saved = (Path(place) / "store" / "map.json").exists()
    if quiet:
        print(summary("quiet", quiet))
    print(summary(f"beside {o.busy} busy loops" if o.busy else "quiet", kills))
    poseless, imageless = beyond(lost, quiet + kills), beyond(unseen, quiet + kills)
    said = sum(len(frames) for _, frames in told)
    print(f"load {os.getloadavg()[0]:.1f}; ended in {ended_s:.1f} s, map saved: {saved}; recordings lack "
          f"{len(lost)} of {len(poses.at_s)} poses, {poseless} of these beyond a second from a kill, and {len(unseen)} "
          f"images, {imageless} of these; {said} more are said to be missing")  # fmt: skip
    return int(good(kills) < SHARE * len(kills) or poseless + imageless > 0 or not saved)


if __name__ == "__main__":
    sys.exit(main())
