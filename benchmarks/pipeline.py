"""The whole pipeline on a recorded fisheye sequence: frames a second, drops, latency, memory.

    python -m benchmarks pipeline -- [--recording FILE.mcap] [--minutes 5] [--memory | --one-core]

Without a recording, `sim:loop` (848x800, 30 Hz) is recorded first as raw images. The sequence is played forwards and
backwards, repeatedly, so that it lasts for minutes without a jump. First as fast as the stages can, then in real
time at 30 Hz, with mapping, loops and logging on. Memory is the sum of the unique set sizes of all processes plus the
shared image ring.

With --memory: half the image size, as fast as it goes, with a log without images. Printed are the growth of each
process and of the log in MB a minute of camera time, once the place is known: after the first third. The exit code is 1
if all processes together grow by more than 1 MiB a minute.

With --one-core: in real time with all processes on one core and a log without images, so that an image that waits
for mapping is dropped. The exit code is 1 if one was.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import psutil

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.paced import PacedSource
from stereo_sfm.drivers.source import Source, open_source
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.messages import Health, StageTimes
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.recording.record import record
from stereo_sfm.types import Dropped, LoopResult

RATE = 30.0
SAMPLE_FRAMES = 150  # between two measurements of memory
LARGEST_GROWTH = 1.0  # MiB a minute of camera time in a known place, all processes


def opened(path: str, frames: int, paced: bool) -> Source:
    """A recording held in memory, forwards and backwards, at 30 Hz."""
    with open_source(path) as recording:
        source = MemorySource(recording.rig, list(recording), count=frames, there_and_back=True)
    return PacedSource(source) if paced else source


class Numbers:
    """Sink that collects the stages' statistics."""

    def __init__(self) -> None:
        self.ms: defaultdict[str, dict[int, float]] = defaultdict(dict)  # of each frame
        self.dropped = self.loops = 0
        self.health: dict[str, Health] = {}

    def put(self, message: object) -> None:
        if isinstance(message, StageTimes):
            for what, ms in message.ms.items():
                self.ms[what][message.frame_id] = ms
        elif isinstance(message, Dropped):
            self.dropped += message.count
        elif isinstance(message, LoopResult):
            self.loops += message.candidate_kf_id >= 0
        elif isinstance(message, Health):
            self.health[message.stage] = message


def memory_mb(run: ProcessRun) -> dict[str, float]:
    """Unique set sizes of the stages without capture, which holds the recording in memory."""
    sizes = {"main": psutil.Process().memory_full_info().uss / 2**20}
    for stage, pid in run.pids.items():
        if stage != "capture" and psutil.pid_exists(pid):
            sizes[stage] = psutil.Process(pid).memory_full_info().uss / 2**20
    return sizes


def play(path: str, frames: int, paced: bool, folder: Path, images: str = "raw") -> int:
    """Play the sequence and print what was measured. Returns the number of images dropped."""
    numbers, memory = Numbers(), list[tuple[float, dict[str, float]]]()
    log = folder / f"{'realtime' if paced else 'fast'}.mcap"
    with ProcessRun(
        MadeSource.of(opened, path, frames, paced), Config(), [numbers], log=LogOptions(log, images)
    ) as run:
        begin = last = time.monotonic()
        first = 0.0
        done = 0
        for _ in run:
            done += 1
            now = time.monotonic()
            first = first or now
            if now - last > 5:
                last = now
                memory.append((now - begin, memory_mb(run)))
        seconds = time.monotonic() - first
    mode = "real time, 30 Hz" if paced else "as fast as it goes"
    print(f"{mode}: {done} of {frames} frames, {done / seconds:.1f} frames/s, {numbers.dropped} dropped")
    print(f"  {numbers.loops} loops closed")
    if paced:
        p50, p95, p99 = np.percentile(list(numbers.ms["latency"].values())[30:], (50, 95, 99))
        print(f"  image to pose: p50 {p50:.1f} ms, p95 {p95:.1f} ms, p99 {p99:.1f} ms")
    for stage, health in sorted(numbers.health.items()):
        print(f"  {stage}: p50 {health.p50_ms:.1f} ms, p95 {health.p95_ms:.1f} ms, {health.rate:.1f} a second")
    for seconds_in, sizes in memory[:: max(len(memory) // 10, 1)]:
        stages = ", ".join(f"{stage} {mb:.0f}" for stage, mb in sizes.items())
        print(f"  memory after {seconds_in:.0f} s: {sum(sizes.values()):.0f} MiB ({stages})")
    print(f"  log {log.stat().st_size / 2**20 / max(seconds, 1e-9):.1f} MiB/s")
    log.unlink()
    return numbers.dropped


def slopes(minutes: list[float], sizes: list[dict[str, float]]) -> dict[str, float]:
    """Growth a minute after the first third, of all processes and the log.

    The median of the slopes between all pairs of samples (Theil and Sen): what a process holds while it computes, as
    the optimizer a problem of the size of the map for a moment, is not growth.
    """
    known = [k for k, at in enumerate(minutes) if at >= minutes[-1] / 3]
    first, second = np.triu_indices(len(known), 1)
    x = np.take(minutes, known)
    grown = {name: np.array([sizes[k][name] for k in known]) for name in sizes[-1]}
    return {name: float(np.median((mib[second] - mib[first]) / (x[second] - x[first]))) for name, mib in grown.items()}


def growth(path: str, frames: int, folder: Path) -> int:
    """Print how memory and log grow; 1 if it is too much."""
    log, record = folder / "growth.mcap", RunRecord.of(Config())
    minutes, sizes = list[float](), list[dict[str, float]]()
    source = MadeSource.of(opened, path, frames, False)
    with ProcessRun(source, Config(), [record], log=LogOptions(log, "none")) as run:
        for done, _ in enumerate(run):
            if done % SAMPLE_FRAMES == 0:
                minutes.append(done / RATE / 60)
                sizes.append({**memory_mb(run), "log": log.stat().st_size / 2**20})
    print(f"{frames / RATE / 60:.1f} min of camera time, {len(record.keyframes)} keyframes, {len(record.closed)} loops")
    for at, now in list(zip(minutes, sizes, strict=True))[:: max(len(sizes) // 10, 1)]:
        print(f"  after {at:5.1f} min: " + ", ".join(f"{name} {mib:.0f}" for name, mib in now.items()))
    found = slopes(minutes, sizes)
    peak = max(sum(mib for name, mib in now.items() if name != "log") for now in sizes)
    total = sum(slope for name, slope in found.items() if name != "log")
    for name, slope in found.items():
        print(f"  {name:10s}{sizes[-1][name]:8.1f} MiB {slope:+7.2f} MiB a minute")
    print(f"  all processes {total:+.2f} MiB a minute, at most {peak:.0f} MiB")
    return int(total > LARGEST_GROWTH)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recording", help="raw MCAP recording of sim:loop")
    parser.add_argument("--frames", type=int, default=600, help="of sim:loop to record when there is no recording")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--fast", action="store_true", help="only as fast as it goes, not in real time")
    parser.add_argument("--memory", action="store_true", help="only the growth of memory and log")
    parser.add_argument("--one-core", action="store_true", help="only in real time, all processes on one core")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = args.recording or str(folder / "loop.mcap")
        if args.recording is None:
            size = "&size=424x400" if args.memory else ""
            with open_source(f"sim:loop?frames={args.frames}{size}") as source:
                for _ in record(source, Path(path), "raw"):
                    pass
        frames = round(args.minutes * 60 * RATE)
        if args.memory:
            return growth(path, frames, folder)
        if args.one_core:
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # the processes of the run inherit it
            return int(play(path, frames, True, folder, "none") > 0)
        for paced in (False, True) if not args.fast else (False,):
            play(path, frames, paced, folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
