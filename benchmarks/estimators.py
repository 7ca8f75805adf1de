"""The tracking step of every feature and estimator of the papers and of ours, on the same images, one thread.

    python benchmarks/estimators.py [--frames N] [SOURCE ...]

Frame by frame each of them does its step, then ours its own, so that a busy machine slows both. Reading and rendering
images is not timed, nor are the first frames, in which code is compiled. A ratio below 1 means that ours is quicker.
"""

from __future__ import annotations

import argparse
import dataclasses
import time

from _sequences import one_thread, sequences

one_thread()

import numpy as np

from stereo_sfm.config import Config
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.ablation import FEATURES, grid
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.factory import AnyTracker, make_tracker
from stereo_sfm.types import StereoImage

WARM_UP = 5  # frames
SOURCES = ("kitti", "euroc_mh01", "rgbd_dataset_freiburg1_xyz", "sim:loop?size=424x400&rate=10",
           "sim:loop?camera=pinhole&size=424x400&rate=10")  # fmt: skip


def step_ms(tracker: AnyTracker, image: StereoImage) -> float:
    """Milliseconds of one step."""
    start = time.perf_counter()
    tracker.step(image)
    return (time.perf_counter() - start) * 1e3


def _ours(theirs: Config) -> Config:
    """The default tracker, with the work for mapping and loops if the other one has it too."""
    config = Config()
    mapper = dataclasses.replace(config.mapper, enabled=theirs.mapper.enabled)
    return dataclasses.replace(
        config, mapper=mapper, loop=dataclasses.replace(config.loop, enabled=theirs.loop.enabled)
    )


def measure(name: str, spec: str, frames: int) -> None:
    """Print the table of one sequence."""
    with open_source(spec) as source:
        images = [image for image, _ in zip(source, range(frames + WARM_UP), strict=False)]
        print(f"\n{name}, {len(images) - WARM_UP} frames: milliseconds (median), ours / theirs: medians, means")
        for cell in grid([spec], FEATURES, stages=["tracking"], systems=["retail-thesis", "cpp-course"]):
            config = cell.config()
            theirs = make_tracker(config, source.rig, NoSpans(), source.ground_truth)
            ours = make_tracker(_ours(config), source.rig, NoSpans(), source.ground_truth)
            times = np.array([(step_ms(theirs, image), step_ms(ours, image)) for image in images])[WARM_UP:]
            (a, b), (mean_a, mean_b) = np.median(times, axis=0), times.mean(0)
            print(f"  {cell.name:24s} {a:7.1f}  ours {b:5.1f}  ratio {b / a:.2f}  {mean_b / mean_a:.2f}", flush=True)


def main() -> None:
    """Every sequence that is named, or those of docs/ablation.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="*", default=list(SOURCES), help="folder names of the data root, or sources")
    parser.add_argument("--frames", type=int, default=30)
    args = parser.parse_args()
    for name, spec in sequences(args.source):
        measure(name, spec, args.frames)


if __name__ == "__main__":
    main()
