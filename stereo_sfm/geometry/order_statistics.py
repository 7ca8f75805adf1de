"""Medians and percentiles of some hundred finite values: numpy takes longer to begin than these kernels to finish."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.types import F64


@njit
def median(values):
    """Median of values (N,), N > 0."""
    return np.median(values)


def percentile(values: F64, percent: float) -> float:
    """Percentile of values (N,), N > 0, linear between neighbours. Numba's takes five seconds to compile."""
    rank = 1 + (len(values) - 1) * (percent / 100.0)
    below = int(rank)
    ordered = np.sort(values)
    lower, upper = float(ordered[below - 1]), float(ordered[min(below, len(values) - 1)])
    return lower * (1 - (rank - below)) + upper * (rank - below)


@njit
def median_distance(a, b, counted):
    """Median distance of the points (N, 2) a from b, of those `counted` (N,); infinite for none."""
    distance, n = np.empty(len(a)), 0
    for k in range(len(a)):
        if counted[k]:
            distance[n] = np.sqrt((a[k, 0] - b[k, 0]) ** 2 + (a[k, 1] - b[k, 1]) ** 2)
            n += 1
    return np.median(distance[:n]) if n else np.inf
