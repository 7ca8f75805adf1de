"""Processor time of all processes together for a frame, in units of ORB on both images of the frame.

    python benchmarks/processor_time.py [--frames N] [SOURCE ...]

The pipeline runs over processes with mapping, loops and a log without images, as fast as it goes, on images held in
memory: decoding them is not counted. Counted are user and system time of every process from when it has loaded its
code to the last frame. ORB (`cv2.ORB_create(1000).detectAndCompute`) is timed on images of the same
sequence while the run goes on, in processor time too, so that a busy machine slows both. The exit code is 1 if a
sequence takes more than 1.2 ORBs.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import tempfile
import time
from pathlib import Path

from _sequences import one_thread, sequences

one_thread()

import cv2
import numpy as np
import psutil

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.source import Source, open_source
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.types import StereoImage

LIMIT = 1.2
SAMPLE_FRAMES = 10
ORBS = 25  # images on which ORB is timed
STEREO = ("kitti", "euroc_mh01", "sim:loop")


def opened(spec: str, frames: int) -> Source:
    """The first images of a source, in memory."""
    with open_source(spec) as source:
        images = [image for image, _ in zip(source, range(frames), strict=False)]
        return MemorySource(source.rig, images, source.ground_truth, source.name)


def orb_s(orb: cv2.ORB, image: StereoImage) -> float:
    """Processor seconds of ORB on both images."""
    start = time.thread_time()
    for pixels in (image.left, image.left if image.right is None else image.right):
        orb.detectAndCompute(pixels, None)
    return time.thread_time() - start


def used(run: ProcessRun) -> dict[str, float]:
    """Processor seconds so far of each process that has not ended."""
    seconds = dict[str, float]()
    for stage, pid in {"main": os.getpid(), **run.pids}.items():
        with contextlib.suppress(psutil.NoSuchProcess):
            process = psutil.Process(pid)
            if process.status() != psutil.STATUS_ZOMBIE:
                seconds[stage] = sum(process.cpu_times()[:2])
    return seconds


class MeasuredRun(ProcessRun):
    """Keeps what each process had used when it was ready; the optimizer is when the mapper is."""

    at_ready: dict[str, float]

    def _begin(self, stage: str) -> None:
        now = used(self)
        if stage == "tracker":  # the first image is read now
            self.at_ready = now | self.at_ready
        loaded = {"tracker": ("tracker",), "mapper": ("mapper", "optimizer"), "loop": ("loop",)}[stage]
        self.at_ready |= {name: now[name] for name in loaded}
        super()._begin(stage)


def measure(name: str, spec: str, frames: int) -> float:
    """Print one row; the ratio."""
    kept = opened(spec, frames)
    images = list(kept)
    samples = images[:: max(len(images) // ORBS, 1)]
    orb = cv2.ORB_create(1000)  # pyright: ignore[reportAttributeAccessIssue]
    orb_s(orb, samples[0])
    timed, own_s, end, counted = list[float](), 0.0, dict[str, float](), 0
    with tempfile.TemporaryDirectory() as folder:
        log = LogOptions(Path(folder) / "run.mcap", "none")
        run = MeasuredRun(MadeSource.of(opened, spec, frames), Config(), [], log=log)
        run.at_ready = {}
        with run:
            for done, _ in enumerate(run, 1):
                before = time.thread_time()
                if run.began_s is not None and done * ORBS >= len(timed) * len(images) and len(timed) < len(samples):
                    timed.append(orb_s(orb, samples[len(timed)]))
                now = used(run) if done % SAMPLE_FRAMES == 0 and run.began_s is not None else {}
                own_s += time.thread_time() - before
                if "tracker" in now:
                    counted, end = done, {**end, **now, "main": now["main"] - own_s}
    begin = run.at_ready
    ms = {stage: (end[stage] - begin[stage]) / counted * 1e3 for stage in end}
    orb_ms = float(np.median(timed)) * 1e3
    ratio = sum(ms.values()) / orb_ms
    stages = ", ".join(f"{stage} {value:.1f}" for stage, value in ms.items())
    print(f"{name}: {counted} frames, {sum(ms.values()):.1f} ms a frame, ORB {orb_ms:.1f} ms, ratio {ratio:.2f}")
    print(f"  {stages} ms", flush=True)
    return ratio


def main() -> int:
    """Print a row for each sequence; 1 if one takes too long."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*")
    parser.add_argument("--frames", type=int, default=600)
    args = parser.parse_args()
    chosen = [(name, spec) for name, spec in sequences(args.sources) if args.sources or Path(name).name in STEREO]
    return int(max(measure(name, spec, args.frames) for name, spec in chosen) > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
