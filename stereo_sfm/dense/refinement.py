"""Sub-pixel refinement of disparities: each window is aligned with the other image as a slanted plane.

Gauss-Newton on the disparity of the middle (Lucas and Kanade, IJCAI 1981), with zero-mean differences, for brightness
may differ between the cameras. The plane's slopes come from the disparities around; a pixel counts by its distance, by
its likeness to the middle (Yoon and Kweon, PAMI 28, 2006) and by how well its disparity lies on the plane, so that
windows at depth edges do not mix two surfaces.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.kernels import inner, njit
from stereo_sfm.types import F32, U8

RADIUS = 4  # px of a window
SPREAD = 2.5  # px, standard deviation of the weights by distance
LIKENESS = 20.0  # grey levels at which the weight by likeness falls to 1/e
ON_PLANE = 0.5  # px from the plane at which a pixel's weight falls to a quarter
SAME_SURFACE = 1.5  # px of disparity from the middle's within which a pixel takes part in the plane
FLAT_PX2 = 0.3  # added to the spread of x and of y (a window's: 6.7), so that few values in a row give no slope across
UNKNOWN_WEIGHT = 0.05  # of pixels without disparity: mostly occluded, but they may be all that there is
ITERATIONS = 6
ENOUGH_PX = 0.05  # change after which the next one is within the noise
FITS = 3  # of a plane, reweighed: the first one's weights are those of a flat one, so that a step makes no slope
FARTHEST = 1.5  # px from the start: beyond, another match was found
LEAST_GRADIENT = 0.03  # grey levels a pixel, root mean square in a window: below, rounding decides
MATCH_PX = 1.5  # px, standard deviation of the matcher's disparity: holds windows with hardly any texture
GREY_NOISE = 1.0  # grey levels, of a camera's pixel after rounding and resampling
NO_VALUES = (0.0,) * 9  # sums of `plane_through`


def refine(left: U8, right: U8, disparity: F32, step: int = 1) -> tuple[F32, F32]:
    """Refined (H, W) px disparities, and the standard deviations (H, W) px that grey-level noise alone would give.

    Args:
        left, right: (H, W) rectified images.
        disparity: (H, W) px from matching, NaN where unknown.
        step: px between the pixels that are refined, along rows and columns; the results are smaller by it.

    Returns:
        NaN where a window has no texture along the row or drifts away.
    """
    offset = np.arange(-RADIUS, RADIUS + 1)
    near = np.exp(-(offset[:, None] ** 2 + offset[None, :] ** 2) / (2 * SPREAD**2)).ravel()
    like = np.exp(-np.arange(256) / LIKENESS)
    return _refine(left, right, disparity, near, like, step)


@inner
def with_value(sums, k, x, y, d):
    """The sums of `plane_through` with one more value, of weight k."""
    n, sx, sy, sxx, syy, sxy, sd, sxd, syd = sums
    return (
        n + k, sx + k * x, sy + k * y, sxx + k * x * x, syy + k * y * y, sxy + k * x * y,
        sd + k * d, sxd + k * x * d, syd + k * y * d,
    )  # fmt: skip


@inner
def plane_through(sums):
    """Least squares from weighted sums over x, y and d: slopes along both, d at the origin, its variance."""
    n, sx, sy, sxx, syy, sxy, sd, sxd, syd = sums
    mx, my, md = sx / n, sy / n, sd / n
    xx, yy, xy = sxx / n - mx * mx + FLAT_PX2, syy / n - my * my + FLAT_PX2, sxy / n - mx * my
    xd, yd = sxd / n - mx * md, syd / n - my * md
    det = xx * yy - xy * xy
    a, b = (yy * xd - xy * yd) / det, (xx * yd - xy * xd) / det
    return a, b, md - a * mx - b * my, (1.0 + (yy * mx * mx - 2.0 * xy * mx * my + xx * my * my) / det) / n


@inner
def _slopes(disparity, u, v):
    """Slopes of the disparity along columns and rows around a pixel, by robust least squares over its surface."""
    a = b = c = 0.0
    middle = disparity[v, u]
    for _ in range(FITS):
        sums = NO_VALUES
        for dy in range(-RADIUS, RADIUS + 1, 2):  # every other one tells as much of a plane
            for dx in range(-RADIUS, RADIUS + 1, 2):
                q = disparity[v + dy, u + dx] - middle
                if not abs(q) <= SAME_SURFACE:
                    continue
                off = (q - c - a * dx - b * dy) / ON_PLANE
                sums = with_value(sums, 1.0 / (1.0 + off * off) ** 2, dx, dy, q)
        a, b, c, _ = plane_through(sums)
    return a, b


@njit
def _refine(left, right, disparity, near, like, step):
    h, w = left.shape
    rows_out, columns_out = (h + step - 1) // step, (w + step - 1) // step
    out = np.full((rows_out, columns_out), np.nan, np.float32)
    sigma = out.copy()
    size = (2 * RADIUS + 1) ** 2
    weight, grey, rows, shift = np.empty(size), np.empty(size), np.empty(size, np.int64), np.empty(size)
    held = (GREY_NOISE / MATCH_PX) ** 2
    for v in range(-(-RADIUS // step) * step, h - RADIUS, step):
        for u in range(-(-RADIUS // step) * step, w - RADIUS, step):
            start = disparity[v, u]
            if math.isnan(start):
                continue
            a, b = _slopes(disparity, u, v)
            middle, count = np.int64(left[v, u]), 0
            for dy in range(-RADIUS, RADIUS + 1):
                for dx in range(-RADIUS, RADIUS + 1):
                    tilt = a * dx + b * dy
                    off = (disparity[v + dy, u + dx] - start - tilt) / ON_PLANE
                    fits = UNKNOWN_WEIGHT if math.isnan(off) else 1.0 / (1.0 + off * off) ** 2
                    value = np.int64(left[v + dy, u + dx])  # uint8 would wrap round
                    k = (dy + RADIUS) * (2 * RADIUS + 1) + dx + RADIUS
                    weight[count] = near[k] * like[abs(value - middle)] * fits
                    grey[count] = value
                    rows[count] = v + dy
                    shift[count] = u + dx - tilt
                    count += 1
            found, done = float(start), False
            gain = squares = spread = total = 0.0
            for _ in range(ITERATIONS):
                total = ws = wt = wss = wst = wtt = vv = vs = vss = 0.0  # of weights, slopes, differences
                for k in range(count):
                    x = shift[k] - found
                    j = int(math.floor(x))
                    if j < 1 or j + 2 >= w:
                        weight[k] = 0.0
                        continue
                    f = x - j
                    p0, p1 = float(right[rows[k], j - 1]), float(right[rows[k], j])
                    p2, p3 = float(right[rows[k], j + 1]), float(right[rows[k], j + 2])
                    c1, c2, c3 = p2 - p0, 2 * p0 - 5 * p1 + 4 * p2 - p3, 3 * (p1 - p2) + p3 - p0  # Catmull-Rom
                    t = grey[k] - (p1 + 0.5 * f * (c1 + f * (c2 + f * c3)))
                    s = 0.5 * c1 + f * (c2 + 1.5 * f * c3)
                    m = weight[k]
                    ms, mt, mm = m * s, m * t, m * m
                    total += m
                    ws += ms
                    wt += mt
                    wss += ms * s
                    wst += ms * t
                    wtt += mt * t
                    vv += mm
                    vs += mm * s
                    vss += ms * ms
                if total < 1e-6:
                    break
                mean = ws / total
                gain, pull = wss - mean * ws, wst - mean * wt
                spread = max(vss - 2 * mean * vs + mean * mean * vv, 0.0)
                if gain < LEAST_GRADIENT * LEAST_GRADIENT * total:
                    break
                change = min(max(-pull / (gain + held * total), -0.5), 0.5)
                found += change
                if abs(found - start) > FARTHEST:
                    break
                squares = max(wtt - wt * wt / total, 0.0) / total
                done = True
                if abs(change) < ENOUGH_PX:
                    break
            if done and gain >= LEAST_GRADIENT * LEAST_GRADIENT * total and abs(found - start) <= FARTHEST:
                out[v // step, u // step] = found
                sigma[v // step, u // step] = math.sqrt((squares + GREY_NOISE * GREY_NOISE) * spread) / gain
    return out, sigma
