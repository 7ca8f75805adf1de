"""How far disparities are off, learned from the image itself.

Grey-level noise explains a part of a disparity's error; windows that are not quite planes, lenses and resampling add
more. What they add shows on surfaces: of three windows in a row that share no pixel, the middle one should have the
mean of the others. Second differences d(-1) - 2 d(0) + d(+1) have six times the variance of one disparity where errors
are independent. Their quantile that holds 68 %, by the noise that grey levels predict, is the standard deviation: gross
errors and bent surfaces are in it, errors that three windows share are not.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.dense.refinement import SAME_SURFACE
from stereo_sfm.types import F32

BINS = 16  # by predicted noise, of equal numbers
FEW = 50  # second differences a bin: below, the image is too empty to learn from
ONE_SIGMA = 0.6827  # share within one standard deviation
UNLEARNED = 2.0  # over the predicted noise, where nothing can be learned


def learned_sigmas(disparity: F32, predicted: F32, apart: int, sparse: int = 1) -> F32:
    """(H, W) px standard deviations of disparities (H, W), from those (H, W) that grey-level noise predicts.

    `apart`: rows or columns between two that share no pixel. `sparse`: learn from every such row and column alone.
    """
    some = np.s_[::sparse, ::sparse]
    found, noise = _second_differences(disparity[some], predicted[some], -(-apart // sparse))
    if len(found) < BINS * FEW:
        return (UNLEARNED * predicted).astype(np.float32)
    order = np.argsort(noise, kind="stable")
    parts = np.array_split(order, BINS)
    x = [float(np.median(noise[part])) for part in parts]
    y = [float(np.quantile(found[part], ONE_SIGMA)) for part in parts]
    return np.interp(predicted, x, y).astype(np.float32)  # keeps NaN


def _second_differences(disparity: F32, predicted: F32, away: int) -> tuple[F32, F32]:
    """Absolute second differences over the root of six, along rows and columns, and their predicted noise."""
    found: list[F32] = []
    noise: list[F32] = []
    for axis in (0, 1):
        n = disparity.shape[axis]
        if n <= 2 * away:
            continue
        low, mid, high = (range(i, n - 2 * away + i) for i in (0, away, 2 * away))
        a, b, c = (disparity.take(part, axis) for part in (low, mid, high))
        sa, sb, sc = (predicted.take(part, axis) for part in (low, mid, high))
        one = (np.abs(a - b) <= SAME_SURFACE) & (np.abs(c - b) <= SAME_SURFACE)
        found.append((np.abs(a - 2 * b + c)[one] / np.sqrt(6)).astype(np.float32))
        noise.append(np.sqrt((sa * sa + 4 * sb * sb + sc * sc)[one] / 6).astype(np.float32))
    empty = np.zeros(0, np.float32)
    return np.concatenate([empty, *found]), np.concatenate([empty, *noise])
