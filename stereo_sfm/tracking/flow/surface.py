"""Test whether two matched windows show one surface, by the residual of a fitted disparity plane.

If a window of the left image and its match in the right one show one smooth surface, their difference is noise and, to
first order, the gradient along the epipolar direction times a disparity that is a plane over the window (slanted
supports, Bleyer et al., PatchMatch Stereo, BMVC 2011). If a depth edge crosses the window, one side of it is occluded
in one camera, and no plane explains those pixels. Such a match is a mixture of surfaces, and its corner is often no
physical point.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportPrivateUsage=false, reportCallIssue=false
# pyright: reportMissingTypeArgument=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.kernels import njit, project_one, unproject_one
from stereo_sfm.geometry.small_matrix import solve_symmetric
from stereo_sfm.tracking.flow.klt import HALF, _inside
from stereo_sfm.tracking.flow.windows import FLAT_SIZE, SIZE, STRIDE, WIDE_SIZE, dot, sample, sample_wide

CELL = 4  # px, side of the cells whose residuals are tested
CELLS = SIZE // CELL
NOISE = 2.0  # grey levels, of the difference of two pixels
INTERPOLATION = 0.1  # px, noise of interpolation: times the gradient, in grey levels
DAMPING = 0.02  # of the plane's slopes, as a share of the information about the disparity itself


@njit
def _epipolar(cameras, ur, vr):
    """Unit direction (2,) px in the right image towards nearer points; NaN if undefined."""
    ex, ey, ez = unproject_one(cameras.model_r, cameras.params_r, ur, vr)
    if math.isnan(ex):
        return math.nan, math.nan
    p = project_one(cameras.model_r, cameras.params_r, ex, ey, ez)
    t = cameras.right_T_left
    du = p[2] * t[0, 3] + p[3] * t[1, 3] + p[4] * t[2, 3]
    dv = p[5] * t[0, 3] + p[6] * t[1, 3] + p[7] * t[2, 3]
    n = math.sqrt(du * du + dv * dv)
    if n < 1e-12:
        return math.nan, math.nan
    return du / n, dv / n


@njit
def fit_planes(left, right, uv, uv_right, cameras, weights, coordinates):
    """Disparity planes of matched windows, and their residuals.

    Args:
        left, right: (H, W) uint8. uv, uv_right: (N, 2) px, matches to a fraction of a pixel; NaN is skipped.
        cameras: StereoCameras. weights, coordinates: klt.WEIGHTS, klt.COORDINATES.

    Returns:
        (N, 2) px in the right image: the match with the plane taken into account. (N,) the worst cell's mean squared
        residual in squares of the expected noise, inf where not tested. (N,) standard deviation in px of the match
        along the epipolar direction by the residual, inf where not tested.
    """
    n = uv.shape[0]
    out = uv_right.copy()
    misfit, sigma = np.full(n, np.inf), np.full(n, np.inf)
    tmp = np.zeros(FLAT_SIZE, np.float32)
    wide, window = np.zeros(WIDE_SIZE + STRIDE, np.float32), np.zeros(FLAT_SIZE, np.float32)
    patch, gradient2 = np.zeros(FLAT_SIZE, np.float32), np.zeros(FLAT_SIZE, np.float32)
    jac, weighted = np.zeros((4, FLAT_SIZE), np.float32), np.zeros(FLAT_SIZE, np.float32)
    normal, factor, rhs, x = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros(4), np.zeros(4)
    half, eighth = np.float32(0.5), np.float32(0.125)
    for k in range(n):
        u, v, ur, vr = uv[k, 0], uv[k, 1], uv_right[k, 0], uv_right[k, 1]
        if math.isnan(ur) or not (_inside(left, u, v, HALF + 1.5) and _inside(right, ur, vr, HALF + 0.5)):
            continue
        eu, ev = _epipolar(cameras, ur, vr)
        if math.isnan(eu):
            continue
        sample_wide(left, u - HALF, v - HALF, wide)
        sample(right, ur - HALF, vr - HALF, window)
        a, b = np.float32(eu), np.float32(ev)
        for m in range(FLAT_SIZE):
            patch[m] = wide[m + STRIDE + 1]
            gx = half * (wide[m + STRIDE + 2] - wide[m + STRIDE])
            gy = half * (wide[m + 2 * STRIDE + 1] - wide[m + 1])
            along = a * gx + b * gy
            jac[0, m] = along
            jac[1, m] = along * coordinates[0, m] * eighth
            jac[2, m] = along * coordinates[1, m] * eighth
            jac[3, m] = a * gy - b * gx
            gradient2[m] = gx * gx + gy * gy
        mean_l, mean_r = dot(patch, weights), dot(window, weights)
        for m in range(FLAT_SIZE):
            patch[m] -= mean_l
            window[m] -= mean_r
            weighted[m] = patch[m] * weights[m]
        contrast_l = math.sqrt(max(dot(weighted, patch), 1e-6))
        for m in range(FLAT_SIZE):
            weighted[m] = window[m] * weights[m]
        contrast_r = math.sqrt(max(dot(weighted, window), 1e-6))
        gain = np.float32(min(max(contrast_l / contrast_r, 0.4), 2.5))
        for m in range(FLAT_SIZE):
            window[m] = gain * window[m] - patch[m]
        for i in range(4):
            mean = dot(jac[i], weights)
            for m in range(FLAT_SIZE):
                jac[i, m] -= mean
                weighted[m] = jac[i, m] * weights[m]
            rhs[i] = dot(weighted, window)
            for j in range(i + 1):
                normal[i, j] = dot(weighted, jac[j])
                normal[j, i] = normal[i, j]
        known = normal[0, 0]
        normal[1, 1] += DAMPING * known
        normal[2, 2] += DAMPING * known
        for i in range(4):
            normal[i, i] += 1e-3
        if not solve_symmetric(normal, rhs, x, factor):
            continue
        s0, s1, s2, s3 = np.float32(x[0]), np.float32(x[1]), np.float32(x[2]), np.float32(x[3])
        noise, interpolation = np.float32(NOISE * NOISE), np.float32(INTERPOLATION * INTERPOLATION)
        for m in range(FLAT_SIZE):
            rest = window[m] - (s0 * jac[0, m] + s1 * jac[1, m] + s2 * jac[2, m] + s3 * jac[3, m])
            window[m] = rest * rest
            tmp[m] = window[m] / (noise + interpolation * gradient2[m])
        worst = 0.0
        for top in range(CELLS):
            for side in range(CELLS):
                total = np.float32(0)
                for i in range(CELL):
                    at = (top * CELL + i) * STRIDE + side * CELL
                    total += (tmp[at] + tmp[at + 1]) + (tmp[at + 2] + tmp[at + 3])
                worst = max(worst, total / (CELL * CELL))
        misfit[k] = worst
        information = known - normal[3, 0] * normal[3, 0] / normal[3, 3]  # with a shift across the curve eliminated
        # Each of CELLS^2 cells measures the disparity once.
        sigma[k] = math.sqrt(dot(window, weights) / max(information, 1e-6)) / CELLS
        out[k, 0] = ur - (x[0] * eu - x[3] * ev)
        out[k, 1] = vr - (x[0] * ev + x[3] * eu)
    return out, misfit, sigma
