"""The mean disparity of a surface around each pixel, each neighbour weighed by how well its own window knows it.

A window on a floor or a white wall shows mostly noise, and its best match is drawn to where interpolation smooths that
noise: by up to 0.1 px, with a sign that changes with the disparity's fraction (Schreier et al., Optical Engineering 39,
2000). Windows around it have other fractions and other noise. A plane through them, weighed by inverse variances,
averages both; where the middle has texture it counts alone.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.dense.refinement import FITS, NO_VALUES, RADIUS, SAME_SURFACE, plane_through, with_value
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.types import F32

RINGS = 2  # of windows around the middle's; a window overlaps the next by half
WIDTH = 2.0  # standard deviations from the plane at which a window's weight falls to a quarter
SUPPORT = 2 * (RINGS + 1) * RADIUS + 1  # px, side of what takes part


def surface_means(disparity: F32, sigma: F32, step: int = 1) -> tuple[F32, F32]:
    """Plane fits at each pixel (H, W) px, and their standard deviations (H, W) were all windows independent.

    Args:
        disparity, sigma: (H, W) px of single windows, NaN where unknown; the sigmas may have any common factor.
        step: px of the image between two of them.
    """
    return _means(disparity, sigma, max(1, RADIUS // step))


@njit
def _means(disparity, sigma, pitch):
    h, w = disparity.shape
    out = np.full((h, w), np.nan, np.float32)
    spread = out.copy()
    reach = RINGS * pitch
    for v in range(h):
        for u in range(w):
            middle = disparity[v, u]
            if math.isnan(middle):
                continue
            a = b = c = variance = 0.0
            own = sigma[v, u] * sigma[v, u]
            for _ in range(FITS):
                sums = NO_VALUES
                for y in range(v - reach, v + reach + 1, pitch):
                    if y < 0 or y >= h:
                        continue
                    for x in range(u - reach, u + reach + 1, pitch):
                        if x < 0 or x >= w:
                            continue
                        q = disparity[y, x] - middle
                        if not abs(q) <= SAME_SURFACE:
                            continue
                        dx, dy, square = x - u, y - v, sigma[y, x] * sigma[y, x]
                        off = q - c - a * dx - b * dy
                        fits = 1.0 + off * off / (WIDTH * WIDTH * (own + square))
                        sums = with_value(sums, 1.0 / (square * fits * fits), dx, dy, q)
                a, b, c, variance = plane_through(sums)
            out[v, u] = middle + c
            spread[v, u] = math.sqrt(variance)
    return out, spread
