"""Stereo matching by a search along the epipolar curve, for any camera model."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false
# pyright: reportPrivateUsage=false

from __future__ import annotations

import math

import cv2
import numpy as np

from stereo_sfm.geometry.kernels import njit, project_one, unproject_one
from stereo_sfm.types import I32, U8

PATCH = 4  # half size of the search patch, in pixels of the search level
SIZE = 2 * PATCH + 1
AREA = SIZE * SIZE
SHORT = 8  # pixels side by side, of which fewer are compared one by one
NODES = 4  # candidates from one that is projected to the next, between which the curve is all but straight


def patch_sums(image: U8) -> I32:
    """(H, W) sum of the search patch around each pixel."""
    return cv2.boxFilter(image, cv2.CV_32S, (SIZE, SIZE), normalize=False).astype(np.int32, copy=False)


@njit
def _cut(image, u, v, patch):
    """Write the patch around a pixel into a flat array."""
    for y in range(SIZE):
        row = image[v - PATCH + y, u - PATCH : u + PATCH + 1]
        for x in range(SIZE):
            patch[y * SIZE + x] = row[x]


@njit
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
def _difference(right, ru, rv, template, brighter, patch):
    """AREA times the sum of differences to the patch around a pixel: a whole number, and those are summed at once."""
    _cut(right, ru, rv, patch)
    total = np.int32(0)
    for m in range(AREA):
        total += abs(np.int32(AREA) * (patch[m] - template[m]) - brighter)
    return total


@njit
def _differences_along(right, right_sums, ru, rv, template, total, weighted, columns):
    """As `_difference`, around successive pixels of a row from `ru` on: (C,), written to `columns`."""
    n = len(columns)
    columns[:] = 0
    sums = right_sums[rv, ru : ru + n]
    for y in range(SIZE):
        row = right[rv - PATCH + y, ru - PATCH : ru + n + PATCH]
        for x in range(n + SIZE - 1):
            weighted[x] = np.int32(AREA) * np.int32(row[x])
        for x in range(SIZE):
            away = np.int32(AREA) * template[y * SIZE + x] - total
            shifted = weighted[x : x + n]
            for c in range(n):
                columns[c] += abs(shifted[c] - sums[c] - away)


@njit
def _pixels(where, scale, shape, pixels):
    """Write the pixel (C, 2) of each position (C, 2) in the full image; -1 where the patch leaves the image."""
    h, w = shape
    for c in range(len(where)):
        pixels[c, 0] = pixels[c, 1] = -1
        if not math.isnan(where[c, 0]):
            u, v = int(round(where[c, 0] / scale)), int(round(where[c, 1] / scale))
            if u >= PATCH and v >= PATCH and u < w - PATCH and v < h - PATCH:
                pixels[c, 0], pixels[c, 1] = u, v


@njit
def _differences(right, right_sums, pixels, template, total, patch, columns, weighted, cost):
    """Mean difference (C,) of the patches around pixels (C, 2), 1e9 where they are -1; written to `cost`.

    Successive ones lie mostly side by side in a row: those are compared together.
    """
    begin = 0
    while begin < len(pixels):
        low = high = last = pixels[begin, 0]
        v, end = pixels[begin, 1], begin + 1
        while end < len(pixels) and pixels[end, 1] == v and abs(pixels[end, 0] - last) <= 1:
            last = pixels[end, 0]
            low, high = min(low, last), max(high, last)
            end += 1
        span = high - low + 1
        if v < 0:
            cost[begin:end] = 1e9
        elif span < SHORT:
            for c in range(begin, end):
                u = pixels[c, 0]
                if c > begin and u == pixels[c - 1, 0]:
                    cost[c] = cost[c - 1]
                else:
                    brighter = np.int32(right_sums[v, u] - total)
                    cost[c] = _difference(right, u, v, template, brighter, patch) / (AREA * AREA)
        else:
            _differences_along(right, right_sums, low, v, template, total, weighted, columns[:span])
            for c in range(begin, end):
                cost[c] = columns[pixels[c, 0] - low] / (AREA * AREA)
        begin = end


@njit
def search_epipolar(
    left, right, right_sums, uv, scale, model_l, params_l, model_r, params_r, right_T_left, min_depth, candidates,
    max_cost, ratio,
):  # fmt: skip
    """Coarse position in the right image of points of the left one.

    Mean-free absolute differences of patches along the epipolar curve, sampled evenly in inverse distance.

    Args:
        left, right: (H, W) uint8, one pyramid level whose pixels are `scale` pixels of the full image.
        right_sums: (H, W) int32, the sum of the patch around each pixel of `right` (`patch_sums`).
        uv: (N, 2) px of the full left image. right_T_left: (4, 4). min_depth: metres, nearest distance searched.
        candidates: how many inverse distances. max_cost: grey levels a pixel. ratio: the second best cost, away from
            the best, must be at least this much larger.

    Returns:
        (N, 2) px of the full right image, NaN without a clear best.
    """
    n = uv.shape[0]
    out = np.full((n, 2), np.nan)
    h, w = left.shape
    cost = np.empty(candidates)
    where = np.empty((candidates, 2))
    template = np.empty(AREA, np.int32)
    pixels = np.empty((candidates, 2), np.int64)
    patch = np.empty(AREA, np.int32)
    columns, weighted = np.empty(candidates, np.int32), np.empty(candidates + SIZE, np.int32)
    for k in range(n):
        iu, iv = int(round(uv[k, 0] / scale)), int(round(uv[k, 1] / scale))
        if iu < PATCH or iv < PATCH or iu >= w - PATCH or iv >= h - PATCH:
            continue
        # the patch is cut at whole pixels: search for that pixel's own bearing
        bx, by, bz = unproject_one(model_l, params_l, iu * scale, iv * scale)
        if math.isnan(bx):
            continue
        _cut(left, iu, iv, template)
        total = np.int32(0)
        for m in range(AREA):
            total += template[m]
        _curve(bx, by, bz, model_r, params_r, right_T_left, min_depth, where)
        _pixels(where, scale, right.shape, pixels)
        _differences(right, right_sums, pixels, template, total, patch, columns, weighted, cost)
        best, best_index = 1e9, -1
        for c in range(candidates):
            if cost[c] < best:
                best, best_index = cost[c], c
        if best_index < 0 or best > max_cost:
            continue
        bu, bv = where[best_index, 0], where[best_index, 1]
        second = 1e9
        for c in range(candidates):
            if cost[c] < second:
                du, dv = where[c, 0] - bu, where[c, 1] - bv
                if du * du + dv * dv > (3.0 * scale) ** 2:
                    second = cost[c]
        if second < ratio * best + 0.5:
            continue
        out[k, 0] = bu + uv[k, 0] - iu * scale
        out[k, 1] = bv + uv[k, 1] - iv * scale
    return out


@njit
def triangulate(uv_left, uv_right, model_l, params_l, model_r, params_r, left_T_right, sigma):
    """Distance of stereo matches along the left bearing, by least squares in the right image's epipolar direction.

    Returns:
        bearing (N, 3) unit, left camera; rho (N,) inverse distance 1/m; variance (N,) of rho for noise of `sigma` (N,)
        px along the epipolar curve; epipolar (N,) px distance of the right observation from it. NaN where impossible.
    """
    n = uv_left.shape[0]
    bearing = np.full((n, 3), np.nan)
    rho = np.full(n, np.nan)
    variance = np.full(n, np.nan)
    epipolar = np.full(n, np.nan)
    right_T_left = np.zeros((3, 4))
    for i in range(3):
        for j in range(3):
            right_T_left[i, j] = left_T_right[j, i]
            right_T_left[i, 3] -= left_T_right[j, i] * left_T_right[j, 3]
    for k in range(n):
        bx, by, bz = unproject_one(model_l, params_l, uv_left[k, 0], uv_left[k, 1])
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
        along = (ju * eu + jv * ev) / math.sqrt(jj)
        epipolar[k] = math.sqrt(max(eu * eu + ev * ev - along * along, 0.0))
    return bearing, rho, variance, epipolar
