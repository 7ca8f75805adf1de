"""The tracking step compared with `cv2.ORB_create(1000).detectAndCompute` on both images of the same frame, one thread.

    python benchmarks/speed.py [--frames N] [SOURCE ...]

A step ends with the frame's pose. At keyframes new points and descriptors follow, for the next frames, the mapper and
the loop closer, while the next image is awaited: the last column. Both are timed frame by frame in one run, so that a
busy machine slows both. Reading and rendering images is not timed, nor are the first frames, in which code is compiled.
RGB-D frames have one image, which is processed twice.
"""

from __future__ import annotations

import argparse
import time

from _sequences import one_thread, sequences

one_thread()

import cv2
import numpy as np
from _figures import Figure, write

from stereo_sfm.config import Config
from stereo_sfm.drivers.source import open_source
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.types import StereoImage

WARM_UP = 10  # frames
SMALL = 20  # sequences with fewer frames are too short for timing
HEADING = (
    "| sequence | image | frames | tracking step p50 | p95 | ORB on both images p50 | ratio of medians | of p95 "
    "| points p50 | a keyframe's points and descriptors |",
    "|---|---|---|---|---|---|---|---|---|---|",
)


def orb_ms(orb: cv2.ORB, image: StereoImage) -> float:
    """Milliseconds for both images."""
    other = image.left if image.right is None else image.right
    start = time.perf_counter()
    orb.detectAndCompute(image.left, None)
    orb.detectAndCompute(other, None)
    return (time.perf_counter() - start) * 1e3


def measure(name: str, spec: str, frames: int) -> tuple[str, list[Figure]] | None:
    """One table row and its figures; None for a sequence that is too short."""
    orb = cv2.ORB_create(1000)  # pyright: ignore[reportAttributeAccessIssue]
    step: list[float] = []
    extraction: list[float] = []
    description: list[float] = []
    points: list[int] = []
    with open_source(spec) as source:
        if source.frame_count is not None and source.frame_count < SMALL:
            return None
        tracker = make_tracker(Config(), source.rig, NoSpans(), source.ground_truth)
        for i, image in enumerate(source):
            start = time.perf_counter()
            frame, keyframe = tracker.step(image)
            spent = (time.perf_counter() - start) * 1e3
            described = 0.0
            if keyframe is not None:
                start = time.perf_counter()
                tracker.describe(keyframe)
                described = (time.perf_counter() - start) * 1e3
            other = orb_ms(orb, image)
            if i >= WARM_UP:
                step.append(spent)
                extraction.append(other)
                points.append(len(frame.observations))
                description += [described] if keyframe is not None else []
            if len(step) == frames:
                break
        width, height = source.rig.left.size
    p50, p95 = np.percentile(step, [50, 95])
    base = float(np.median(extraction))
    title = f"{name}, {width}×{height}"
    figures = [
        Figure(title, "step, median", p50, "ms"),
        Figure(title, "over ORB on both images", p50 / base),
        Figure(title, "95th percentile over ORB's", p95 / base),
        Figure(title, "points", float(np.median(points))),
        Figure(title, "a keyframe's points, after the pose", float(np.median(description or [0.0])), "ms"),
    ]
    row = (
        f"| {name} | {width}×{height} | {len(step)} | {p50:.1f} ms | {p95:.1f} ms | {base:.1f} ms "
        f"| {p50 / base:.2f} | {p95 / base:.2f} | {int(np.median(points))} "
        f"| {np.median(description) if description else 0.0:.1f} ms |"
    )
    return row, figures


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", nargs="*", help="folder names of the data root, or sources")
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--write", action="store_true", help="keep the figures for the page of results")
    args = parser.parse_args()
    figures: list[Figure] = []
    print("\n".join(HEADING))
    for name, spec in sequences(args.source):
        found = measure(name, spec, args.frames)
        if found is not None:
            print(found[0], flush=True)
            figures += found[1]
    if args.write:
        print(write("speed", "Time of a tracking step", figures))


if __name__ == "__main__":
    main()
