"""Search for points seen before from a distant pose: their first appearances, deformed as the new view would show them.

A point's surface is taken for a plane that faces one of the axes of the camera that saw it: shelves beside the camera,
floor and ceiling, what it drives towards. Of the three the one that looks most alike counts. The deformation of a
window by a plane seen from two poses is Hartley & Zisserman, Multiple View Geometry, section 13.1, here by differences,
for any camera model. The search goes over a square around the predicted pixel, in the half image.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.kernels import inner, njit, project_one
from stereo_sfm.geometry.se3_kernels import transform_point
from stereo_sfm.tracking.flow.klt import HALF
from stereo_sfm.tracking.flow.windows import SIZE, STRIDE
from stereo_sfm.types import F32, F64, I64, U8

GRAZING = 0.15  # cosine between a surface's normal and the ray, below which the surface shows nothing
MAX_STRETCH = 3.0  # of a window, in any direction
COARSE = SIZE // 2  # samples of a window in the half image, along each side
SAMPLES = COARSE * COARSE
MIN_VARIANCE = 1e-3  # of a window, grey levels squared


def surfaces_around(camera: Camera, uv: F64, points: F64) -> F64:
    """(3, 4, N, 3) metres: surfaces that face the camera's x, y and z axis, right, left, below and above of points.

    They do not depend on the view from which the points are looked for. NaN where seen too obliquely.

    Args:
        uv: (N, 2) px. points: (N, 3) metres in the camera.
    """
    out = np.full((3, 4, len(uv), 3), np.nan)
    bearings = points / np.linalg.norm(points, axis=1)[:, None]
    rays = [camera.unproject(uv + sign * step) for step in np.eye(2) for sign in (1.0, -1.0)]
    for axis in range(3):
        facing = np.flatnonzero(np.abs(bearings[:, axis]) >= GRAZING)
        depth = points[facing, axis]
        for k, ray in enumerate(rays):
            out[axis, k, facing] = ray[facing] * (depth / ray[facing, axis])[:, None]
    return out


def plane_warps(camera: Camera, surfaces: F64, new_T_old: F64) -> F64:
    """(3, N, 2, 2) deformation of the image around points by a motion (4, 4) of the camera.

    `surfaces`: from `surfaces_around`, of the old image. NaN where there is none, or where it changes too much.
    """
    return _warps(camera.model_id, camera.params, surfaces, new_T_old)


@njit
def _warps(model, params, surfaces, new_T_old):
    count = surfaces.shape[2]
    out, ends = np.full((3, count, 2, 2), np.nan), np.zeros((4, 2))
    for axis in range(3):
        for n in range(count):
            if math.isnan(surfaces[axis, 0, n, 0]):
                continue
            for k in range(4):
                x, y, z = surfaces[axis, k, n, 0], surfaces[axis, k, n, 1], surfaces[axis, k, n, 2]
                x, y, z = transform_point(new_T_old, x, y, z)
                seen = project_one(model, params, x, y, z)
                ends[k, 0], ends[k, 1] = seen[0], seen[1]
            squared = 0.0
            for i in range(2):
                for k in range(2):
                    value = (ends[2 * k, i] - ends[2 * k + 1, i]) / 2
                    out[axis, n, i, k] = value
                    squared += value * value
            stretch = math.sqrt(0.5 * squared)
            if not 1 / MAX_STRETCH <= stretch <= MAX_STRETCH:
                out[axis, n] = np.nan
    return out


def find_deformed(
    half_image: U8, uv: F64, warps: F64, slots: I64, patch: F32, radius: int, step: int, uv_out: F64, warp_out: F64
) -> F64:
    """Where the windows of points, deformed, look most alike around predicted pixels.

    Args:
        half_image: (H / 2, W / 2) uint8. uv: (N, 2) px of the image, predicted; not searched where NaN.
        warps: (K, N, 2, 2) deformations to try. slots: (N,) rows of patch (M, FLAT_SIZE). radius, step: of the search,
            px of the half image.
        uv_out: (N, 2), warp_out: (N, 2, 2): the best, overwritten.

    Returns:
        (N,) normalised correlation of the best, 0 where nothing was searched.
    """
    height, width = half_image.shape
    phases = _phases(half_image, step)
    return _find_deformed(phases, height, width, uv, warps, slots, patch, radius, step, uv_out, warp_out)


def _phases(image: U8, step: int) -> F32:
    """(step, step, H / step, W / step): every step-th pixel of an image (H, W), from each of the first ones on.

    What a search by steps looks at lies side by side in them.
    """
    height, width = image.shape
    out = np.zeros((step, step, -(-height // step), -(-width // step)), np.float32)
    for i in range(step):
        for j in range(step):
            part = image[i::step, j::step]
            out[i, j, : part.shape[0], : part.shape[1]] = part
    return out


@njit
def _find_deformed(phases, height, width, uv, warps, slots, patch, radius, step, uv_out, warp_out):
    best = np.zeros(uv.shape[0])
    small = np.zeros(SAMPLES, np.float32)
    corner, weight = np.zeros((SAMPLES, 2), np.int64), np.zeros((4, SAMPLES), np.float32)
    start = np.zeros((4, SAMPLES), np.int64)
    side = int(2 * radius + 2 * MAX_STRETCH * (COARSE - 1)) // step + 3  # of a window stretched along both sides
    area = np.zeros(step * step * side * side, np.float32)
    sums, squares = np.zeros(side * side, np.float32), np.zeros(side * side, np.float32)
    cross = np.zeros(side * side, np.float32)
    for k in range(uv.shape[0]):
        if not (math.isfinite(uv[k, 0]) and math.isfinite(uv[k, 1])):
            continue
        power = _halved_window(patch[slots[k]], small)
        if power < MIN_VARIANCE:
            continue
        for w in range(warps.shape[0]):
            warp = warps[w, k]
            if not math.isfinite(warp.sum()):
                continue
            left, right, top, bottom = _sample_places(uv[k], warp, corner, weight)
            u0, columns = _offsets(left, right, width, radius, step)
            v0, rows = _offsets(top, bottom, height, radius, step)
            if columns <= 0 or rows <= 0:
                continue
            c0, r0 = (int(math.floor(left)) + u0) // step, (int(math.floor(top)) + v0) // step
            wide = (int(math.floor(right)) + 1 + u0) // step + columns - c0
            high = (int(math.floor(bottom)) + 1 + v0) // step + rows - r0
            if step * step * wide * high > len(area):  # a window larger than any that is moderately deformed
                continue
            _copy(phases, step, c0, r0, wide, high, area)
            for m in range(SAMPLES):
                row, below = divmod(corner[m, 1] + v0, step), divmod(corner[m, 1] + v0 + 1, step)
                column, beside = divmod(corner[m, 0] + u0, step), divmod(corner[m, 0] + u0 + 1, step)
                upper, lower = (row[0] - r0) * wide - c0, (below[0] - r0) * wide - c0
                start[0, m] = (row[1] * step + column[1]) * high * wide + upper + column[0]
                start[1, m] = (row[1] * step + beside[1]) * high * wide + upper + beside[0]
                start[2, m] = (below[1] * step + column[1]) * high * wide + lower + column[0]
                start[3, m] = (below[1] * step + beside[1]) * high * wide + lower + beside[0]
            _products(area, start, weight, small, (rows - 1) * wide + columns, sums, squares, cross)
            for y in range(rows):
                row_of = slice(y * wide, y * wide + columns)
                if not _promising(sums[row_of], squares[row_of], cross[row_of], best[k] * best[k] * power):
                    continue
                for x in range(columns):
                    n = y * wide + x
                    variance = squares[n] - sums[n] * sums[n] / SAMPLES
                    if variance < MIN_VARIANCE:
                        continue
                    ncc = cross[n] / math.sqrt(variance * power)
                    if ncc > best[k]:
                        best[k] = ncc
                        uv_out[k, 0], uv_out[k, 1] = uv[k, 0] + 2 * (u0 + step * x), uv[k, 1] + 2 * (v0 + step * y)
                        warp_out[k, 0, 0], warp_out[k, 0, 1] = warp[0, 0], warp[0, 1]
                        warp_out[k, 1, 0], warp_out[k, 1, 1] = warp[1, 0], warp[1, 1]
    return best


@njit
def _offsets(low, high, size, radius, step):
    """First offset and number of offsets of a search with which samples from `low` to `high` stay in the image."""
    first, last = -radius, radius
    while first <= last and low + first < 0:
        first += step
    while last >= first and high + last >= size - 1:
        last -= 1
    return first, (last - first) // step + 1


@inner
def _copy(phases, step, c0, r0, wide, high, area):
    """Write the part of all phases from column c0 and row r0 on into a flat array."""
    columns = min(wide, phases.shape[3] - c0)
    for i in range(step):
        for j in range(step):
            for r in range(min(high, phases.shape[2] - r0)):
                line = phases[i, j, r0 + r, c0 : c0 + columns]
                to = area[((i * step + j) * high + r) * wide :]
                for c in range(columns):
                    to[c] = line[c]


@inner
def _promising(sums, squares, cross, least):
    """Whether the square of any correlation may exceed `least` times its variance."""
    count = 0
    for n in range(len(sums)):
        variance = squares[n] - sums[n] * sums[n] * np.float32(1 / SAMPLES)
        count += cross[n] > 0 and cross[n] * cross[n] >= np.float32(0.999 * least) * variance
    return count > 0


@inner
def _halved_window(window, small):
    """Write the samples of a window (FLAT_SIZE,) in the half image, less their mean; returns the sum of squares."""
    mean, power = 0.0, 0.0
    for i in range(COARSE):
        for j in range(COARSE):
            at = 2 * i * STRIDE + 2 * j
            value = 0.25 * (window[at] + window[at + 1] + window[at + STRIDE] + window[at + STRIDE + 1])
            small[i * COARSE + j] = value
            mean += value
    for m in range(SAMPLES):
        small[m] -= mean / SAMPLES
        power += small[m] * small[m]
    return power


@inner
def _sample_places(uv, warp, corner, weight):
    """Pixels (SAMPLES, 2) and bilinear weights (4, SAMPLES) of a deformed window; its left, right, top and bottom."""
    left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
    for i in range(COARSE):
        y = 2 * i + 0.5 - HALF
        for j in range(COARSE):
            x, m = 2 * j + 0.5 - HALF, i * COARSE + j
            u = 0.5 * (uv[0] + warp[0, 0] * x + warp[0, 1] * y)
            v = 0.5 * (uv[1] + warp[1, 0] * x + warp[1, 1] * y)
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
            corner[m, 0], corner[m, 1] = int(math.floor(u)), int(math.floor(v))
            fu, fv = u - corner[m, 0], v - corner[m, 1]
            weight[0, m], weight[1, m] = (1 - fu) * (1 - fv), fu * (1 - fv)
            weight[2, m], weight[3, m] = (1 - fu) * fv, fu * fv
    return left, right, top, bottom


@inner
def _products(area, start, weight, small, count, sums, squares, cross):
    """Sums (count,) of the samples, their squares and their products with a window, at successive places of an area.

    The places run on from the end of one row to the next: those between the rows mean nothing. Long loops over two
    samples at once are what makes this fast.
    """
    sums[:count], squares[:count], cross[:count] = 0.0, 0.0, 0.0
    for m in range(0, SAMPLES, 2):
        n = m + 1
        a0, b0, c0, d0, e0 = weight[0, m], weight[1, m], weight[2, m], weight[3, m], small[m]
        a1, b1, c1, d1, e1 = weight[0, n], weight[1, n], weight[2, n], weight[3, n], small[n]
        p0, p1, p2, p3 = area[start[0, m] :], area[start[1, m] :], area[start[2, m] :], area[start[3, m] :]
        q0, q1, q2, q3 = area[start[0, n] :], area[start[1, n] :], area[start[2, n] :], area[start[3, n] :]
        for x in range(np.uintp(count)):  # unsigned: no test for negative indices
            p = a0 * p0[x] + b0 * p1[x] + c0 * p2[x] + d0 * p3[x]
            q = a1 * q0[x] + b1 * q1[x] + c1 * q2[x] + d1 * q3[x]
            sums[x] = sums[x] + p + q
            squares[x] = squares[x] + p * p + q * q
            cross[x] = cross[x] + p * e0 + q * e1
