"""Sudden changes of the rig in real sequences: right images as of a camera that turned in the middle."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.source import Source
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.geometry import se3
from stereo_sfm.types import F32, StereoImage

# Name -> axis of the right camera, degrees.
STEPS = {
    "step 0.1 x": (0, 0.1),
    "step 0.1 y": (1, 0.1),
    "step 0.2 z": (2, 0.2),
    "step 0.3 y": (1, 0.3),
    "step 0.5 y": (1, -0.5),
}
RIGHT_AMOUNT = 0.5, 1.5  # of the step, about its axis


class Turned(WrappedSource):
    """A source whose right camera turns in the middle."""

    def __init__(self, source: Source, step: str) -> None:
        super().__init__(source)
        stamps = source.stamps()
        assert stamps is not None and len(stamps.stamp_ns)
        self.first_ns, last_ns = int(stamps.stamp_ns[0]), int(stamps.stamp_ns[-1])
        self.middle_ns = (self.first_ns + last_ns) // 2
        self._map = warp(source.rig, step)

    def __iter__(self) -> Iterator[StereoImage]:
        for image in self.source:
            if image.right is None or image.stamp_ns < self.middle_ns:
                yield image
            else:
                yield replace(image, right=cv2.remap(image.right, *self._map, cv2.INTER_LINEAR))


def warp(rig: Rig, step: str) -> tuple[F32, F32]:
    """(H, W) px each: where the right camera saw what it sees after it turned."""
    assert rig.right is not None
    axis, degrees = STEPS[step]
    rotation = se3.so3_exp(np.deg2rad(degrees) * np.eye(3)[axis])
    uv = rig.right.project(rig.right.bearing_grid() @ rotation.T).astype(np.float32)
    return np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1])


def found_after_s(step: str, changes: list[dict[str, Any]], at_s: float) -> float | None:
    """After how many seconds the changes of a run's calibration (`stats.json`) have the step, by about its amount."""
    axis, degrees = STEPS[step]
    before = 0.0
    for change in (c for c in changes if c["applied"]):
        by, late = (change["terms"][axis] - before) / degrees, change["seconds"] - at_s
        before = change["terms"][axis]
        if change["why"] == "step" and late >= 0 and RIGHT_AMOUNT[0] <= by <= RIGHT_AMOUNT[1]:
            return late
    return None
