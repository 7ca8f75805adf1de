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
    hr, wr = right.shape
    cost = np.empty(candidates)
    where = np.empty((candidates, 2))
    template = np.empty(AREA, np.int32)
    patch = np.empty(AREA, np.int32)
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
        best, best_index = 1e9, -1
        last_u, last_v = -10000, -10000
        for c in range(candidates):
            cost[c] = 1e9
            if math.isnan(where[c, 0]):
                continue
            ru, rv = int(round(where[c, 0] / scale)), int(round(where[c, 1] / scale))
            if ru < PATCH or rv < PATCH or ru >= wr - PATCH or rv >= hr - PATCH:
                continue
            if ru == last_u and rv == last_v:
                cost[c] = cost[c - 1]
                continue
            last_u, last_v = ru, rv
            _cut(right, ru, rv, patch)
            brighter = np.int32(right_sums[rv, ru] - total)
            difference = np.int32(0)  # AREA times too large, so that it is a whole number: those are summed at once
            for m in range(AREA):
                difference += abs(np.int32(AREA) * (patch[m] - template[m]) - brighter)
            cost[c] = difference / (AREA * AREA)
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
