"""The service for hours of camera time, with everything that goes wrong on a robot: what grows, what recovers.

    python -m benchmarks soak -- [--minutes 240] [--source sim:loop?size=424x400] [--distinct 600] [--work DIR]

Images come from memory as fast as the pipeline takes them, there and back along a path again and again. Over the time
the camera is unplugged, the lights go out, the disk fills up (by its limits), and each stage is killed or stopped.
Printed: the resident memory of each process with its slope per hour of camera time after the first third, every fault
and how long it took, missing poses, recordings against their quota. The exit code is 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.native import read_native, write_native
from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.drivers.source import BaseSource, open_source
from stereo_sfm.recording.segments import recordings, segments
from stereo_sfm.service.config import MapConfig, RecordingConfig, RobotConfig
from stereo_sfm.service.messages import HealthReport, PoseUpdate, Started, Status
from stereo_sfm.service.service import Service
from stereo_sfm.types import StereoImage

RATE = 30.0
UNPLUGGED_S, DARK_FRAMES = 2.0, 60
STAGES = ("capture", "tracker", "mapper", "loop", "optimizer", "recorder")
SETTLE_S = 60.0  # for the service to run again after a fault
SLOPE_MB_H = 1.0  # allowed growth of a process
MIN_MINUTES = 90  # of camera time, for a slope to mean anything


class StoreCamera(BaseSource):
    """Images in a file in memory, there and back; each life goes on where the one before ended."""

    name = "soak"

    def __init__(self, folder: Path, count: int, unplugged: tuple[int, ...], dark: tuple[int, ...]) -> None:
        self.rig = read_native(folder / "rig.yaml")
        self._left, self._right = (np.load(folder / f"{side}.npy", mmap_mode="r") for side in ("left", "right"))
        self._at = np.memmap(folder / "at", np.int64, "r+", shape=(1,))
        self._count, self._unplugged, self._dark = count, set(unplugged), dark

    def __iter__(self) -> Iterator[StereoImage]:
        n = len(self._left)
        for k in range(int(self._at[0]), self._count):
            self._at[0] = k + 1
            if k in self._unplugged:
                time.sleep(UNPLUGGED_S)
            at = k % (2 * n - 2)
            at = at if at < n else 2 * n - 2 - at
            left, right = np.array(self._left[at]), np.array(self._right[at])
            if any(begin <= k < begin + DARK_FRAMES for begin in self._dark):
                left, right = np.zeros_like(left), np.zeros_like(right)
            yield StereoImage(k, 1_000_000_000 + round(k * 1e9 / RATE), left, right)


def store(spec: str, distinct: int, folder: Path) -> None:
    """Render or read the images once."""
    with open_source(spec) as source:
        images = list(itertools.islice(source, distinct))
        write_native(source.rig, folder / "rig.yaml")
    np.save(folder / "left.npy", np.stack([image.left for image in images]))
    np.save(folder / "right.npy", np.stack([image.right for image in images if image.right is not None]))
    np.zeros(1, np.int64).tofile(folder / "at")


@dataclass
class Watch:
    """What the service says."""

    frame: int = -1
    poses: int = 0
    untracked: int = 0
    missing: dict[int, int] = field(default_factory=dict[int, int])  # first missing frame -> how many
    states: list[tuple[int, str, str]] = field(default_factory=list[tuple[int, str, str]])
    sessions: list[int] = field(default_factory=list[int])  # frames at which they began
    rss: list[tuple[int, dict[str, int]]] = field(default_factory=list[tuple[int, dict[str, int]]])
    health: HealthReport | None = None
    over_quota: float = 0.0
    tracked: bool = False

    def pose(self, pose: PoseUpdate) -> None:
        if pose.frame_id > self.frame + 1:
            self.missing[self.frame + 1] = pose.frame_id - self.frame - 1
        self.frame, self.tracked = pose.frame_id, pose.tracked
        self.poses += 1
        self.untracked += not pose.tracked

    def status(self, status: Status) -> None:
        if not self.states or self.states[-1][1] != status.state:
            self.states.append((self.frame, str(status.state), status.reason))

    def report(self, report: HealthReport) -> None:
        self.health = report
        self.rss.append((self.frame, {**report.rss, "service": own_rss()}))


def own_rss() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def plan(count: int, times: int, kills: int) -> tuple[list[tuple[int, str]], tuple[int, ...], tuple[int, ...]]:
    """(frame, fault) in order, and the frames of unplugging and darkness; nothing in the first and last tenth."""
    faults = [f"kill {stage}" for _ in range(kills) for stage in STAGES]
    faults += ["stop tracker", "stop mapper", "disk full", "disk full"]
    kinds = [*faults, *["unplug"] * times, *["dark"] * times]
    np.random.default_rng(1).shuffle(kinds)
    frames = np.linspace(0.1 * count, 0.9 * count, len(kinds)).astype(int).tolist()
    events = list(zip(frames, kinds, strict=True))
    unplugged = tuple(f for f, kind in events if kind == "unplug")
    dark = tuple(f for f, kind in events if kind == "dark")
    return [e for e in events if e[1] not in ("unplug", "dark")], unplugged, dark


def cause(service: Service, watch: Watch, fault: str) -> float:
    """Make one fault happen; seconds until poses come again."""
    kind, _, what = fault.partition(" ")
    began, session = time.monotonic(), len(watch.sessions)
    if kind == "disk":
        service.set_setting("recording.min_free_gb", "900000")
        wait_for(lambda: watch.states[-1][1] == "disk_full")
        service.set_setting("recording.min_free_gb", "0.05")
        wait_for(lambda: watch.states[-1][1] != "disk_full")
        return time.monotonic() - began
    pid = service.pids.get(what)
    if pid is None:
        return 0.0
    os.kill(pid, signal.SIGKILL if kind == "kill" else signal.SIGSTOP)
    if what == "recorder":
        wait_for(lambda: service.pids.get(what) not in (None, pid))
    else:
        wait_for(lambda: len(watch.sessions) > session and watch.tracked)
    return time.monotonic() - began


def wait_for(what: Any) -> None:
    end = time.monotonic() + SETTLE_S
    while not what():
        if time.monotonic() > end:
            raise TimeoutError(f"the service did not recover within {SETTLE_S:.0f} s")
        time.sleep(0.02)


def slopes(rss: list[tuple[int, dict[str, int]]], restarts: list[int]) -> dict[str, tuple[float, float]]:
    """Process -> (MB at the end, slope in MB an hour of camera time since its last start and the first third)."""
    out: dict[str, tuple[float, float]] = {}
    for name in sorted({name for _, sizes in rss for name in sizes}):
        since = max([rss[-1][0] / 3, *(r for r in restarts if name != "service")], default=0.0)
        rows = [(k / RATE / 3600, sizes[name] / 1e6) for k, sizes in rss if name in sizes and k >= since]
        if rows:
            x, y = np.array(rows).T
            slope = float(np.polyfit(x, y, 1)[0]) if len(rows) > 10 and np.ptp(x) > 0 else float("nan")
            out[name] = (float(y[-1]), slope)
    return out


def run(minutes: float, spec: str, distinct: int, work: Path, times: int, kills: int) -> list[str]:
    """One soak; what is not as it must be."""
    count = int(minutes * 60 * RATE)
    store(spec, distinct, work)
    events, unplugged, dark = plan(count, times, kills)
    config = RobotConfig(
        map=MapConfig(str(work / "store"), "extend", 5.0),
        recording=RecordingConfig(
            folder=str(work / "recordings"), mode="black_box", image_format="raw", segment_min=0.1, mark_losses=False,
            quota_gb=0.4, min_free_gb=0.05, black_box_min=1.0,
        ),
    )  # fmt: skip
    watch, wrong, took = Watch(), list[str](), list[tuple[int, str, float]]()
    source = MadeSource.of(StoreCamera, work, count, unplugged, dark)
    began = time.monotonic()
    with Service(config, source) as service:
        service.on(PoseUpdate, watch.pose)
        service.on(Status, watch.status)
        service.on(HealthReport, watch.report)
        service.on(Started, lambda started: watch.sessions.append(watch.frame + 1))
        over = threading.Thread(target=watch_quota, args=(service, work / "recordings", watch, 0.4e9), daemon=True)
        over.start()
        for frame, fault in events:
            while watch.frame < frame and not service.wait(0.05):
                pass
            try:
                took.append((frame, fault, cause(service, watch, fault)))
            except TimeoutError as error:
                wrong.append(f"frame {frame}, {fault}: {error}")
        service.wait()
        stop_s = time.monotonic()
    print(f"{count} frames, {minutes:g} min of camera time in {(time.monotonic() - began) / 60:.1f} min")
    print(f"poses {watch.poses}, without a pose {watch.untracked}, sessions {len(watch.sessions)}; "
          f"ended in {time.monotonic() - stop_s:.1f} s")  # fmt: skip
    for frame, fault, seconds in took:
        print(f"  frame {frame:7d}  {fault:16s} {seconds:5.1f} s")
    wrong += judge(watch, work / "recordings", minutes)
    return wrong


def watch_quota(service: Service, root: Path, watch: Watch, limit: float) -> None:
    while not service.wait(1.0):
        used = sum(segment.bytes for folder in recordings(root) for segment in segments(folder))
        watch.over_quota = max(watch.over_quota, used - limit)


def judge(watch: Watch, root: Path, minutes: float) -> list[str]:
    """Print the rest; what is not as it must be."""
    wrong: list[str] = []
    for name, (mb, slope) in slopes(watch.rss, watch.sessions).items():
        print(f"  {name:12s} {mb:7.1f} MB  {slope:+8.2f} MB/h")
        if minutes >= MIN_MINUTES and slope > SLOPE_MB_H:
            wrong.append(f"{name} grows by {slope:.1f} MB an hour")
    unexplained = {k: n for k, n in watch.missing.items() if not any(k <= s <= k + n + 1 for s in watch.sessions)}
    print(f"  frames missing between poses: {sum(watch.missing.values())}, unexplained: {unexplained or 'none'}")
    wrong += [f"{n} frames missing from {k}" for k, n in unexplained.items()]
    kept, images = 0, 0
    for folder in recordings(root):
        with_images = [s for s in segments(folder) if s.images.exists()]
        kept += len(segments(folder))
        if with_images:
            with open_source(folder) as source:
                images += sum(1 for _ in source)
    print(f"  recordings: {kept} segments, {images} images replayed, quota exceeded by {watch.over_quota / 1e6:.0f} MB")
    if watch.over_quota > 0.2e9:
        wrong.append(f"the quota was exceeded by {watch.over_quota / 1e6:.0f} MB")
    if not watch.tracked:
        wrong.append("tracking was lost at the end")
    return wrong


def main(args: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=240.0, help="of camera time")
    parser.add_argument("--source", default="sim:loop?size=424x400")
    parser.add_argument("--distinct", type=int, default=600, help="images in memory")
    parser.add_argument("--times", type=int, default=10, help="unplugged and dark so often")
    parser.add_argument("--kills", type=int, default=3, help="of each stage")
    parser.add_argument("--work", type=Path, help="folder, kept")
    o = parser.parse_args(args)
    with tempfile.TemporaryDirectory() as temporary:
        work = o.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        wrong = run(o.minutes, o.source, o.distinct, work, o.times, o.kills)
    print("\n".join(f"WRONG: {line}" for line in wrong) or "all as it must be")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
