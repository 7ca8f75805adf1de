"""Steps of the rig injected into recordings: right images turned about an axis from the middle on. Which are found?

    python benchmarks/injected_steps.py SOURCE ... [--degrees 0.1 0.2 0.5] [--axes x y z] [--start 5]

A row has when a correction that is a step was reported, in seconds after it happened, and by how much the rotation that
was found differs from the true one. Without any step injected none must be reported: the first row of each source.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator

from _sequences import one_thread

one_thread()

import cv2
import numpy as np
from _runs import recorded

from stereo_sfm import config as configuration
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.select import SelectedFrames
from stereo_sfm.drivers.source import Source, open_source
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, StereoImage

AXES = "xyz"


class TurnedRight(WrappedSource):
    """A source whose right images look turned from a frame on."""

    def __init__(self, source: Source, turn: F64, first: int) -> None:
        """`turn`: (3,) radians about the right camera's axes. `first`: number of the first turned frame."""
        super().__init__(source)
        self.turn, self.first = turn, first
        self.stamp_ns = 0  # of the first turned frame

    def __iter__(self) -> Iterator[StereoImage]:
        seen_at = _seen_at(self.rig, self.turn)
        for number, image in enumerate(self.source):
            if number < self.first or image.right is None:
                yield image
                continue
            self.stamp_ns = self.stamp_ns or image.stamp_ns
            right = cv2.remap(image.right, *seen_at, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
            yield dataclasses.replace(image, right=np.asarray(right, np.uint8))


def _seen_at(rig: Rig, turn: F64) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows at which the true camera saw what the turned one would see at each pixel."""
    assert rig.right is not None
    columns, rows = np.meshgrid(np.arange(rig.right.width, dtype=float), np.arange(rig.right.height, dtype=float))
    rays = rig.right.unproject(np.stack([columns.ravel(), rows.ravel()], 1))
    seen = rig.right.project(rays @ se3.so3_exp(turn).T).astype(np.float32).reshape(*columns.shape, 2)
    return np.ascontiguousarray(seen[..., 0]), np.ascontiguousarray(seen[..., 1])


def row(spec: str, start_s: float, turn: F64, frames: int) -> str:
    """Run and describe."""
    with TurnedRight(SelectedFrames(open_source(spec), start_s=start_s), turn, frames // 2) as source:
        record = recorded(source, configuration.load(None, []))
    steps = [c for c in record.calibrations if c.why == "step"]
    name = (
        "none"
        if not turn.any()
        else f"{AXES[int(np.abs(turn).argmax())]} {np.rad2deg(turn[np.abs(turn).argmax()]):+.2f}"
    )
    if not steps:
        return f"| {spec} | {name} | {'–' if not turn.any() else 'not found'} | |"
    before = next((c.terms for c in reversed(record.calibrations) if c.stamp_ns < steps[0].stamp_ns), np.zeros(8))
    left = np.rad2deg(steps[0].terms[:3] - before[:3] - turn)
    return f"| {spec} | {name} | {(steps[0].stamp_ns - source.stamp_ns) * 1e-9:.1f} s | {np.round(left, 3)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="+")
    parser.add_argument("--degrees", type=float, nargs="*", default=[0.1, 0.2, 0.5])
    parser.add_argument("--axes", nargs="*", choices=list(AXES), default=list(AXES))
    parser.add_argument("--start", type=float, default=0.0, help="seconds after the first frame")
    args = parser.parse_args()
    print("| source | injected, degrees | found after | difference, degrees |\n|---|---|---|---|")
    for spec in args.source:
        with SelectedFrames(open_source(spec), start_s=args.start) as source:
            frames = sum(1 for _ in source)
        turns = [np.deg2rad(d) * np.eye(3)[AXES.index(axis)] for axis in args.axes for d in args.degrees]
        for turn in [np.zeros(3), *turns]:
            print(row(spec, args.start, turn, frames), flush=True)


if __name__ == "__main__":
    main()
