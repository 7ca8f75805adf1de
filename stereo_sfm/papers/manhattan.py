"""The world's three directions as a compass: camera orientation without drift, or nothing where structure is weak."""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.lines import LineDetector
from stereo_sfm.geometry.vanishing import Manhattan, ManhattanLimits, estimate
from stereo_sfm.types import F64, U8


class ManhattanCompass:
    """Measures the images of one camera; pure apart from its detector's tables."""

    def __init__(self, camera: Camera, limits: ManhattanLimits | None = None) -> None:
        self._detector = LineDetector(camera)
        self._limits = limits or ManhattanLimits()

    def measure(self, image: U8, seed: int, expected: F64 | None = None) -> Manhattan:
        """Orientation of the camera in the directions that the lines of an (H, W) image point to.

        Args:
            seed: of the two-line samples. expected: (3, 3) cam_R_axes predicted, which settles the cube's symmetry.

        Raises:
            Degenerate: "too_few_lines", "no_lines" or "weak_structure".
        """
        return estimate(self._detector.detect(image), np.random.default_rng(seed), self._limits, expected)
