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

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.tracking.flow.klt import HALF, SIZE, STRIDE
from stereo_sfm.types import F64

GRAZING = 0.15  # cosine between a surface's normal and the ray, below which the surface shows nothing
DELTA_PX = 1.0  # for differences
MAX_STRETCH = 3.0  # of a window, in any direction
COARSE = SIZE // 2  # samples of a window in the half image, along each side
SAMPLES = COARSE * COARSE
MIN_VARIANCE = 1e-3  # of a window, grey levels squared
LANES = 8  # numbers of a vector instruction


def plane_warps(camera: Camera, uv: F64, points: F64, new_T_old: F64) -> F64:
    """(3, N, 2, 2) deformation of the image around points by a motion of the camera, for three orientations of surface.

    Args:
        uv: (N, 2) px in the old image. points: (N, 3) metres in the old camera. new_T_old: (4, 4).

    Returns:
        Surfaces that face the old camera's x, y and z axis; NaN where the surface is seen too obliquely.
    """
    out = np.full((3, len(uv), 2, 2), np.nan)
    bearings = points / np.linalg.norm(points, axis=1)[:, None]
    ends = [[camera.unproject(uv + sign * step) for sign in (1.0, -1.0)] for step in DELTA_PX * np.eye(2)]
    for axis in range(3):
        facing = np.flatnonzero(np.abs(bearings[:, axis]) >= GRAZING)
        depth = points[facing, axis]
        for k, rays in enumerate(ends):
            on_plane = [ray[facing] * (depth / ray[facing, axis])[:, None] for ray in rays]
            first, last = (camera.project(se3.transform(new_T_old, p)) for p in on_plane)
            out[axis, facing, :, k] = (first - last) / (2 * DELTA_PX)
    stretch = np.linalg.norm(out, axis=(2, 3)) / math.sqrt(2.0)
    with np.errstate(invalid="ignore"):
        out[(stretch > MAX_STRETCH) | (stretch < 1 / MAX_STRETCH)] = np.nan
    return out


@njit
def find_deformed(half_image, uv, warps, slots, patch, radius, step, uv_out, warp_out):
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
    pixels = half_image.ravel()
    best = np.zeros(uv.shape[0])
    small = np.zeros(SAMPLES, np.float32)
    corner, weight = np.zeros((SAMPLES, 2), np.int64), np.zeros((4, SAMPLES), np.float32)
    size = 2 * radius + 1 + LANES
    sums, squares, cross = np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
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
            first, last = -radius, radius  # columns of the search whose samples are in the image
            while first <= last and left + first < 0:
                first += step
            while last >= first and right + last >= width - 1:
                last -= 1
            count = last - first + 1
            for dv in range(-radius, radius + 1, step):
                if count <= 0 or top + dv < 0 or bottom + dv >= height - 1:
                    continue
                _products(pixels, width, corner, weight, small, first, dv, count, sums, squares, cross)
                for x in range(0, count, step):
                    variance = squares[x] - sums[x] * sums[x] / SAMPLES
                    if variance < MIN_VARIANCE:
                        continue
                    ncc = cross[x] / math.sqrt(variance * power)
                    if ncc > best[k]:
                        best[k] = ncc
                        uv_out[k, 0], uv_out[k, 1] = uv[k, 0] + 2 * (first + x), uv[k, 1] + 2 * dv
                        warp_out[k, 0, 0], warp_out[k, 0, 1] = warp[0, 0], warp[0, 1]
                        warp_out[k, 1, 0], warp_out[k, 1, 1] = warp[1, 0], warp[1, 1]
    return best


@njit
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


@njit
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


@njit
def _products(pixels, width, corner, weight, small, first, dv, count, sums, squares, cross):
    """Sums (count,) of the samples, their squares and their products with a window, for columns from `first` on.

    Whole vectors are computed where the image has so many pixels; the surplus columns mean nothing. Unsigned numbers
    spare the compiler the test for negative indices.
    """
    sums[:], squares[:], cross[:] = 0.0, 0.0, 0.0
    one, row = np.uintp(1), np.uintp(width)
    whole = (count + LANES - 1) // LANES * LANES
    for m in range(SAMPLES):
        start = np.uintp((corner[m, 1] + dv) * width + corner[m, 0] + first)
        columns = np.uintp(whole if start + row + whole < len(pixels) else count)
        below = start + row
        a, b, c, d, s = weight[0, m], weight[1, m], weight[2, m], weight[3, m], small[m]
        for x in range(columns):
            value = (
                a * np.float32(pixels[start + x])
                + b * np.float32(pixels[start + x + one])
                + c * np.float32(pixels[below + x])
                + d * np.float32(pixels[below + x + one])
            )
            sums[x] += value
            squares[x] += value * value
            cross[x] += value * s
