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
    n = uv.shape[0]
    height, width = half_image.shape
    best = np.zeros(n)
    small = np.zeros(COARSE * COARSE)
    at_u, at_v = np.zeros(COARSE * COARSE), np.zeros(COARSE * COARSE)
    whole_u, whole_v = np.zeros(COARSE * COARSE, np.int64), np.zeros(COARSE * COARSE, np.int64)
    weight = np.zeros((4, COARSE * COARSE))
    for k in range(n):
        if not (math.isfinite(uv[k, 0]) and math.isfinite(uv[k, 1])):
            continue
        mean, power = 0.0, 0.0
        for i in range(COARSE):
            for j in range(COARSE):
                first = 2 * i * STRIDE + 2 * j
                value = 0.25 * (
                    patch[slots[k], first]
                    + patch[slots[k], first + 1]
                    + patch[slots[k], first + STRIDE]
                    + patch[slots[k], first + STRIDE + 1]
                )
                small[i * COARSE + j] = value
                mean += value
        mean /= small.size
        for m in range(small.size):
            small[m] -= mean
            power += small[m] * small[m]
        if power < 1e-3:
            continue
        for w in range(warps.shape[0]):
            a, b, c, d = warps[w, k, 0, 0], warps[w, k, 0, 1], warps[w, k, 1, 0], warps[w, k, 1, 1]
            if not math.isfinite(a + b + c + d):
                continue
            low_u, high_u, low_v, high_v = 1e9, -1e9, 1e9, -1e9
            for i in range(COARSE):
                y = 2 * i + 0.5 - HALF
                for j in range(COARSE):
                    x, m = 2 * j + 0.5 - HALF, i * COARSE + j
                    at_u[m] = 0.5 * (uv[k, 0] + a * x + b * y)
                    at_v[m] = 0.5 * (uv[k, 1] + c * x + d * y)
                    low_u, high_u = min(low_u, at_u[m]), max(high_u, at_u[m])
                    low_v, high_v = min(low_v, at_v[m]), max(high_v, at_v[m])
                    whole_u[m], whole_v[m] = int(math.floor(at_u[m])), int(math.floor(at_v[m]))
                    fu, fv = at_u[m] - whole_u[m], at_v[m] - whole_v[m]
                    weight[0, m], weight[1, m] = (1 - fu) * (1 - fv), fu * (1 - fv)
                    weight[2, m], weight[3, m] = (1 - fu) * fv, fu * fv
            for dv in range(-radius, radius + 1, step):
                if low_v + dv < 0 or high_v + dv >= height - 1:
                    continue
                for du in range(-radius, radius + 1, step):
                    if low_u + du < 0 or high_u + du >= width - 1:
                        continue
                    sums, squares, cross = 0.0, 0.0, 0.0
                    for m in range(small.size):
                        iu, iv = whole_u[m] + du, whole_v[m] + dv
                        value = (
                            weight[0, m] * half_image[iv, iu]
                            + weight[1, m] * half_image[iv, iu + 1]
                            + weight[2, m] * half_image[iv + 1, iu]
                            + weight[3, m] * half_image[iv + 1, iu + 1]
                        )
                        sums += value
                        squares += value * value
                        cross += value * small[m]
                    variance = squares - sums * sums / small.size
                    if variance < 1e-3:
                        continue
                    ncc = cross / math.sqrt(variance * power)
                    if ncc > best[k]:
                        best[k] = ncc
                        uv_out[k, 0], uv_out[k, 1] = uv[k, 0] + 2 * du, uv[k, 1] + 2 * dv
                        warp_out[k, 0, 0], warp_out[k, 0, 1], warp_out[k, 1, 0], warp_out[k, 1, 1] = a, b, c, d
    return best
