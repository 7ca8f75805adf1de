"""Medians and percentiles of some hundred finite values: numpy takes longer to begin than these kernels to finish."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.types import F64


@njit
def median(values):
    """Median of values (N,), N > 0. Numba's takes five times as long to compile.

    By Hoare's selection (Algorithm 65, CACM 4, 1961) in Wirth's form.
    """
    rest = np.empty(len(values))
    for i in range(len(values)):
        rest[i] = values[i]
    half, low, high = len(values) // 2, 0, len(values) - 1
    while low < high:  # nothing before `low` is larger, nothing behind `high` smaller than what is between them
        pivot, i, j = rest[half], low, high
        while i <= j:
            while rest[i] < pivot:
                i += 1
            while pivot < rest[j]:
                j -= 1
            if i <= j:
                rest[i], rest[j] = rest[j], rest[i]
                i += 1
                j -= 1
        if j < half:
            low = i
        if half < i:
            high = j
    if len(values) % 2:
        return rest[half]
    below = rest[0]
    for i in range(1, half):
        below = max(below, rest[i])
    return (below + rest[half]) / 2


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
    return median(distance[:n]) if n else np.inf
