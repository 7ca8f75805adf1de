"""Compiled normal equations and inliers of a relative pose (loop/absolute_pose.py)."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.kernels import inner, njit, project_one
from stereo_sfm.geometry.se3_kernels import transform_point
from stereo_sfm.loop.p3p import squared_error


@njit
def consistent(t, back, m, lens, limit):
    """(N,): the squared error over its variance is below `limit` from a to b, and from b to a where that is known.

    Args:
        t, back: (4, 4) b_T_a and its inverse. m: Matches. lens: of the left camera.
    """
    out = np.zeros(m.points_a.shape[0], np.bool_)
    for i in range(out.shape[0]):
        if math.isfinite(m.points_a[i, 0]) and math.isfinite(m.uv_left_b[i, 0]):
            out[i] = squared_error(t, m.points_a[i], m.sigmas_a[i], m.uv_left_b[i], lens) < limit
        if out[i] and math.isfinite(m.points_b[i, 0]) and math.isfinite(m.uv_left_a[i, 0]):
            out[i] = not squared_error(back, m.points_b[i], m.sigmas_b[i], m.uv_left_a[i], lens) >= limit
    return out


@njit
def add_normal_equations(t, camera_T_left, ahead, behind, m, use, lens, system):
    """Adds what one camera's images of a and b tell about exp(xi) @ t.

    Args:
        t: (4, 4) b_T_a. camera_T_left: (4, 4). ahead, behind: camera_T_left @ t, and @ inverse(t).
        m: Matches, whose left pixels are those of this camera. use: (N,). lens: of this camera.
        system: hessian (6, 6), gradient (6,), and (2,) squared normalised errors and the number of points.
    """
    _add(t, ahead, camera_T_left, True, m.points_a, m.sigmas_a, m.uv_left_b, use, lens, system)
    _add(t, behind, -behind, False, m.points_b, m.sigmas_b, m.uv_left_a, use, lens, system)


@inner
def _add(t, camera_T_source, turn, forward, points, sigmas, uv, use, lens, system):
    """As `add_normal_equations`, from points seen in one image.

    Args:
        camera_T_source: (4, 4) from the points' frame into the camera.
        turn: its upper left (3, 3) are the derivative of the point in the camera by the point in b.
        forward: the points are in a, and t takes them to b; else they are in b.
        points, sigmas, uv, use: (N, 3), (N,) metres along the ray, (N, 2) px, (N,); NaN where unknown.
    """
    hessian, gradient, sums = system
    s2 = lens.sigma * lens.sigma
    j = np.empty((2, 6))
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not use[i] or not math.isfinite(x) or not math.isfinite(uv[i, 0]):
            continue
        u, v, j00, j01, j02, j10, j11, j12 = project_one(
            lens.model, lens.params, *transform_point(camera_T_source, x, y, z)
        )
        if not math.isfinite(u):
            continue
        b0, b1, b2 = transform_point(t, x, y, z) if forward else (x, y, z)
        for k, (a0, a1, a2) in enumerate(((j00, j01, j02), (j10, j11, j12))):
            g0 = a0 * turn[0, 0] + a1 * turn[1, 0] + a2 * turn[2, 0]
            g1 = a0 * turn[0, 1] + a1 * turn[1, 1] + a2 * turn[2, 1]
            g2 = a0 * turn[0, 2] + a1 * turn[1, 2] + a2 * turn[2, 2]
            j[k, 0], j[k, 1], j[k, 2] = g0, g1, g2
            j[k, 3], j[k, 4], j[k, 5] = b1 * g2 - b2 * g1, b2 * g0 - b0 * g2, b0 * g1 - b1 * g0
        # The range is uncertain along the ray: covariance s2 I + d d^T, inverted by Sherman and Morrison.
        ray = sigmas[i] / max(math.sqrt(x * x + y * y + z * z), 1e-9)
        r0 = camera_T_source[0, 0] * x + camera_T_source[0, 1] * y + camera_T_source[0, 2] * z
        r1 = camera_T_source[1, 0] * x + camera_T_source[1, 1] * y + camera_T_source[1, 2] * z
        r2 = camera_T_source[2, 0] * x + camera_T_source[2, 1] * y + camera_T_source[2, 2] * z
        d0, d1 = ray * (j00 * r0 + j01 * r1 + j02 * r2), ray * (j10 * r0 + j11 * r1 + j12 * r2)
        q = s2 + d0 * d0 + d1 * d1
        w00, w01, w11 = (1.0 - d0 * d0 / q) / s2, -d0 * d1 / q / s2, (1.0 - d1 * d1 / q) / s2
        e0, e1 = u - uv[i, 0], v - uv[i, 1]
        f0, f1 = w00 * e0 + w01 * e1, w01 * e0 + w11 * e1
        for k in range(6):
            h0, h1 = w00 * j[0, k] + w01 * j[1, k], w01 * j[0, k] + w11 * j[1, k]
            gradient[k] += j[0, k] * f0 + j[1, k] * f1
            for m in range(6):
                hessian[k, m] += h0 * j[0, m] + h1 * j[1, m]
        sums[0] += e0 * f0 + e1 * f1
        sums[1] += 1.0
