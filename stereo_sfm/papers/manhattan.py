"""The world's three directions as a compass: camera orientation without drift, or nothing where structure is weak."""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry.lines import LineDetector
from stereo_sfm.geometry.vanishing import Manhattan, estimate
from stereo_sfm.types import F64, U8


def measure(lines: LineDetector, image: U8, seed: int, expected: F64 | None = None) -> Manhattan:
    """Orientation of the camera in the directions that the lines of an (H, W) image point to.

    Args:
        seed: of the two-line samples. expected: (3, 3) cam_R_axes predicted, which settles the cube's symmetry.

    Raises:
        Degenerate: "too_few_lines", "no_lines" or "weak_structure".
    """
    return estimate(lines.detect(image), np.random.default_rng(seed), expected=expected)
