"""Stereo matching by a search along the epipolar curve, for any camera model."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false
# pyright: reportPrivateUsage=false

from __future__ import annotations

import math

import cv2
import numpy as np

from stereo_sfm.geometry.kernels import inner, njit, project_one, unproject_one
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.types import F64, U8

PATCH = 4  # half size of the search patch, in pixels of the search level
SIZE = 2 * PATCH + 1  # of the same, along each side
AREA = SIZE * SIZE
SHORT = 8  # pixels side by side, of which fewer are compared one by one
NODES = 4  # candidates from one that is projected to the next, between which the curve is all but straight


@inner
def _cut(image, u, v, patch):
    """Write the patch around a pixel into a flat array."""
    for y in range(SIZE):
        row = image[v - PATCH + y, u - PATCH : u + PATCH + 1]
        for x in range(SIZE):
            patch[y * SIZE + x] = row[x]


@inner
def _curve(bx, by, bz, model, params, right_T_left, min_depth, where):
    """Pixels (N, 2) of a left bearing in the right image, evenly in inverse distance from infinity to `min_depth`."""
    t, last = right_T_left, len(where) - 1
    x = t[0, 0] * bx + t[0, 1] * by + t[0, 2] * bz
    y = t[1, 0] * bx + t[1, 1] * by + t[1, 2] * bz
    z = t[2, 0] * bx + t[2, 1] * by + t[2, 2] * bz
    before, u0, v0 = -1, 0.0, 0.0
    for node in range(0, last + NODES, NODES):
        c = min(node, last)
        rho = c / (last * min_depth)
        r = project_one(model, params, x + t[0, 3] * rho, y + t[1, 3] * rho, z + t[2, 3] * rho)
        for k in range(before + 1, c + 1):
            share = (k - before) / (c - before)
            where[k, 0], where[k, 1] = u0 + share * (r[0] - u0), v0 + share * (r[1] - v0)
        before, u0, v0 = c, r[0], r[1]


@njit
def _candidates(left, shape, uv, scale, cameras, min_depth, where, pixels, templates):
    """The candidates' positions (N, C, 2) in the full right image, `shape` of the level, see `search_epipolar`.

    Written too: their pixels (N, C, 2) of the level, -1 where the patch leaves the image, and templates (N, AREA).
    """
    h, w = left.shape
    share = 1.0 / scale  # a power of two: products with it are exact
    for k in range(len(uv)):
        for c in range(pixels.shape[1]):
            pixels[k, c, 0] = pixels[k, c, 1] = -1
        iu, iv = int(round(uv[k, 0] / scale)), int(round(uv[k, 1] / scale))
        if iu < PATCH or iv < PATCH or iu >= w - PATCH or iv >= h - PATCH:
            continue
        # the patch is cut at whole pixels: search for that pixel's own bearing
        bx, by, bz = unproject_one(cameras.model_l, cameras.params_l, iu * scale, iv * scale)
        if math.isnan(bx):
            continue
        _cut(left, iu, iv, templates[k])
        _curve(bx, by, bz, cameras.model_r, cameras.params_r, cameras.right_T_left, min_depth, where[k])
        for c in range(pixels.shape[1]):
            if not math.isnan(where[k, c, 0]):
                u, v = int(round(where[k, c, 0] * share)), int(round(where[k, c, 1] * share))
                if u >= PATCH and v >= PATCH and u < shape[1] - PATCH and v < shape[0] - PATCH:
                    pixels[k, c, 0], pixels[k, c, 1] = u, v


@njit
def _costs(right, right_sums, pixels, templates, cost):
    """Mean-free mean differences (N, C) of patches around pixels (N, C, 2) to templates (N, AREA), 1e9 without pixel.

    `right_sums`: (H, W) int32, the sum of the patch around each pixel.
    Differences are summed AREA times too large, so that they are whole numbers. Successive pixels lie mostly side by
    side in a row: those are compared together.
    """
    count = pixels.shape[1]
    patch, away = np.empty(AREA, np.int32), np.empty(SIZE, np.int32)
    columns, weighted = np.empty(count, np.int32), np.empty(count + SIZE, np.int32)
    for k in range(len(pixels)):
        template = templates[k]
        total = np.int32(0)
        for m in range(AREA):
            total = np.int32(total + template[m])
        begin = 0
        while begin < count:
            low = high = last = pixels[k, begin, 0]
            v, end = pixels[k, begin, 1], begin + 1
            while end < count and pixels[k, end, 1] == v and abs(pixels[k, end, 0] - last) <= 1:
                last = pixels[k, end, 0]
                if last < low:
                    low = last
                if last > high:
                    high = last
                end += 1
            n = high - low + 1
            if v < 0:
                for c in range(begin, end):
                    cost[k, c] = 1e9
            elif n < SHORT:
                for c in range(begin, end):
                    u = pixels[k, c, 0]
                    if c > begin and u == pixels[k, c - 1, 0]:
                        cost[k, c] = cost[k, c - 1]
                        continue
                    _cut(right, u, v, patch)
                    brighter, difference = np.int32(right_sums[v, u] - total), np.int32(0)
                    for m in range(AREA):
                        off = np.int32(AREA * (patch[m] - template[m]) - brighter)
                        difference = np.int32(difference + abs(off))
                    cost[k, c] = difference / (AREA * AREA)
            else:
                sums = right_sums[v, low : low + n]
                for c in range(n):
                    columns[c] = 0
                for y in range(SIZE):
                    row = right[v - PATCH + y, low - PATCH : low + n + PATCH]
                    for x in range(n + SIZE - 1):
                        weighted[x] = AREA * row[x]
                    for x in range(SIZE):
                        away[x] = AREA * template[y * SIZE + x] - total
                    for c in range(np.uintp(n)):  # unsigned: no test for negative indices
                        difference = columns[c]
                        for x in range(np.uintp(SIZE)):
                            difference += abs(np.int32(weighted[c + x] - sums[c] - away[x]))
                        columns[c] = difference
                for c in range(begin, end):
                    cost[k, c] = columns[pixels[k, c, 0] - low] / (AREA * AREA)
            begin = end


@njit
def _clear_best(where, cost, uv, scale, out):
    """Write the position (N, 2) with the least cost where the second best, away from it, is clearly worse."""
    for k in range(len(uv)):
        best, best_index = 1e9, -1
        for c in range(cost.shape[1]):
            if cost[k, c] < best:
                best, best_index = cost[k, c], c
        if best_index < 0 or best > 25.0:  # grey levels a pixel
            continue
        bu, bv = where[k, best_index, 0], where[k, best_index, 1]
        second = 1e9
        for c in range(cost.shape[1]):
            if cost[k, c] < second:
                du, dv = where[k, c, 0] - bu, where[k, c, 1] - bv
                if du * du + dv * dv > (3.0 * scale) ** 2:
                    second = cost[k, c]
        if second < 1.2 * best + 0.5:
            continue
        out[k, 0] = bu + uv[k, 0] - int(round(uv[k, 0] / scale)) * scale
        out[k, 1] = bv + uv[k, 1] - int(round(uv[k, 1] / scale)) * scale


def search_epipolar(
    left: U8, right: U8, uv: F64, scale: float, cameras: StereoCameras, min_depth: float, candidates: int
) -> F64:
    """Coarse position in the right image of points of the left one.

    Mean-free absolute differences of patches along the epipolar curve, sampled evenly in inverse distance.

    Args:
        left, right: (H, W) uint8, one pyramid level whose pixels are `scale` pixels of the full image.
        uv: (N, 2) px of the full left image. min_depth: metres, nearest distance searched.
        candidates: how many inverse distances.

    Returns:
        (N, 2) px of the full right image, NaN without a clear best.
    """
    n, out = len(uv), np.full((len(uv), 2), np.nan)
    where, cost = np.empty((n, candidates, 2)), np.empty((n, candidates))
    pixels, templates = np.empty((n, candidates, 2), np.int64), np.empty((n, AREA), np.int32)
    sums = cv2.boxFilter(right, cv2.CV_32S, (SIZE, SIZE), normalize=False).astype(np.int32, copy=False)
    _candidates(left, right.shape, uv, scale, cameras, min_depth, where, pixels, templates)
    _costs(right, sums, pixels, templates, cost)
    _clear_best(where, cost, uv, scale, out)
    return out


@njit
def triangulate(uv_left, uv_right, cameras, sigma):
    """Distance of stereo matches along the left bearing, by least squares in the right image's epipolar direction.

    Returns:
        bearing (N, 3) unit, left camera; rho (N,) inverse distance 1/m; variance (N,) of rho for noise of `sigma` (N,)
        px along the epipolar curve; offset (N, 2) px from it to the right observation. NaN where impossible.
    """
    n = uv_left.shape[0]
    bearing, offset = np.full((n, 3), np.nan), np.full((n, 2), np.nan)
    rho, variance = np.full(n, np.nan), np.full(n, np.nan)
    model_r, params_r, right_T_left = cameras.model_r, cameras.params_r, cameras.right_T_left
    for k in range(n):
        bx, by, bz = unproject_one(cameras.model_l, cameras.params_l, uv_left[k, 0], uv_left[k, 1])
        if math.isnan(bx) or math.isnan(uv_right[k, 0]):
            continue
        dx = right_T_left[0, 0] * bx + right_T_left[0, 1] * by + right_T_left[0, 2] * bz
        dy = right_T_left[1, 0] * bx + right_T_left[1, 1] * by + right_T_left[1, 2] * bz
        dz = right_T_left[2, 0] * bx + right_T_left[2, 1] * by + right_T_left[2, 2] * bz
        tx, ty, tz = right_T_left[0, 3], right_T_left[1, 3], right_T_left[2, 3]
        # start: rho with (d + rho t) parallel to the right bearing, in the least-squares sense
        ex, ey, ez = unproject_one(model_r, params_r, uv_right[k, 0], uv_right[k, 1])
        if math.isnan(ex):
            continue
        ax, ay, az = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex
        cx, cy, cz = ty * ez - tz * ey, tz * ex - tx * ez, tx * ey - ty * ex
        den = cx * cx + cy * cy + cz * cz
        if den < 1e-18:
            continue
        r = -(ax * cx + ay * cy + az * cz) / den
        ok = True
        ju, jv, eu, ev = 0.0, 0.0, 0.0, 0.0
        for _ in range(5):
            p = project_one(model_r, params_r, dx + r * tx, dy + r * ty, dz + r * tz)
            if math.isnan(p[0]):
                ok = False
                break
            ju = p[2] * tx + p[3] * ty + p[4] * tz
            jv = p[5] * tx + p[6] * ty + p[7] * tz
            eu, ev = p[0] - uv_right[k, 0], p[1] - uv_right[k, 1]
            jj = ju * ju + jv * jv
            if jj < 1e-18:
                ok = False
                break
            step = (ju * eu + jv * ev) / jj
            r -= step
            if abs(step) < 1e-10:
                break
        if not ok:
            continue
        bearing[k, 0], bearing[k, 1], bearing[k, 2] = bx, by, bz
        rho[k] = r
        jj = ju * ju + jv * jv
        variance[k] = sigma[k] * sigma[k] / jj
        along = (ju * eu + jv * ev) / jj
        offset[k, 0], offset[k, 1] = along * ju - eu, along * jv - ev
    return bearing, rho, variance, offset
