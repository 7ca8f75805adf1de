"""The direction of walls and shelf fronts in a plan: turned to it, points fall on few lines along the two axes."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.types import F64

MIN_POINTS = 10
COARSE, FINE = np.deg2rad(np.arange(-45.0, 45.0, 1.0)), np.deg2rad(np.arange(-1.0, 1.01, 0.1))


def dominant_direction(flat: F64, weights: F64 | None = None, cell: float = 0.05) -> float:
    """Angle in radians, within 45 degrees of 0, whose axes have the points on the fewest lines; 0 for too few points.

    The angle maximizes the sum of squared counts of the histograms along both axes.

    Args:
        flat: (N, 2) metres. weights: (N,), None: all alike. cell: metres, width of the histograms' cells.
    """
    if len(flat) < MIN_POINTS:
        return 0.0
    flat = np.ascontiguousarray(flat - flat.mean(0), float)
    weights = np.ones(len(flat)) if weights is None else np.ascontiguousarray(weights, float)
    coarse = _sharpness(flat, weights, cell, COARSE)
    fine = COARSE[int(np.argmax(coarse))] + FINE
    return float(fine[int(np.argmax(_sharpness(flat, weights, cell, fine)))])


@njit
def _sharpness(flat, weights, cell, angles):
    """(A,) sums of squared counts of the points turned by each angle."""
    reach = 0.0
    for k in range(flat.shape[0]):
        reach = max(reach, math.hypot(flat[k, 0], flat[k, 1]))
    bins = 2 * int(reach / cell) + 4
    out = np.zeros(angles.shape[0])
    counts = np.zeros((2, bins))
    for a in range(angles.shape[0]):
        c, s = math.cos(angles[a]), math.sin(angles[a])
        counts[:] = 0.0
        for k in range(flat.shape[0]):
            x, y = flat[k, 0], flat[k, 1]
            counts[0, int((c * x + s * y) / cell + 0.5 * bins)] += weights[k]
            counts[1, int((c * y - s * x) / cell + 0.5 * bins)] += weights[k]
        for axis in range(2):
            for b in range(bins - 1):
                both = counts[axis, b] + counts[axis, b + 1]  # a line may lie on the border of two cells
                out[a] += both * both
    return out
