"""Compiled costs, inliers and normal equations of a relative pose (loop/absolute_pose.py)."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereo_sfm.geometry.kernels import inner, njit, project_one
from stereo_sfm.geometry.se3_kernels import transform_point
from stereo_sfm.types import F64


class Lens(NamedTuple):
    """A camera, and the noise of its pixels."""

    model: int
    params: F64
    sigma: float  # px


@inner
def _reprojection(t, point, range_sigma, uv, lens):
    """Error of a point in an image, NaN where the camera cannot see it; its weight; the derivative of its pixel.

    The weight is the inverse of the covariance s2 I + d d^T by Sherman and Morrison: of the pixel's noise, and of the
    point's own range along its ray.

    Args:
        t: takes the point into the camera; its upper (3, 4) are used. range_sigma: metres.
    """
    x, y, z = transform_point(t, point[0], point[1], point[2])
    u, v, j00, j01, j02, j10, j11, j12 = project_one(lens.model, lens.params, x, y, z)
    length = math.sqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2)
    share = range_sigma / length if length > 0 else 0.0
    rx, ry, rz = share * (x - t[0, 3]), share * (y - t[1, 3]), share * (z - t[2, 3])
    d0, d1 = j00 * rx + j01 * ry + j02 * rz, j10 * rx + j11 * ry + j12 * rz
    s2 = lens.sigma * lens.sigma
    q = s2 + d0 * d0 + d1 * d1
    weight = (1.0 - d0 * d0 / q) / s2, -d0 * d1 / q / s2, (1.0 - d1 * d1 / q) / s2
    return (u - uv[0], v - uv[1]), weight, ((j00, j01, j02), (j10, j11, j12))


@inner
def _squared_error(t, point, range_sigma, uv, lens):
    """Squared reprojection error over its variance, NaN where the camera cannot see the point."""
    (e0, e1), (w00, w01, w11), _ = _reprojection(t, point, range_sigma, uv, lens)
    return w00 * e0 * e0 + 2 * w01 * e0 * e1 + w11 * e1 * e1


@njit
def cheapest(poses, inverses, m, lens, limit):
    """Which pose b_T_a of (S, 4, 4) has the smallest truncated cost in both directions (Torr & Zisserman, MSAC, 2000).

    Args:
        m: Matches. lens: of the left camera. limit: of a squared error over its variance.
    """
    best, lowest = 0, math.inf
    for s in range(poses.shape[0]):
        cost = 0.0
        for i in range(m.points_a.shape[0]):
            e = _squared_error(poses[s], m.points_a[i], m.sigmas_a[i], m.uv_left_b[i], lens)
            cost += e if e < limit else limit
            if math.isfinite(m.points_b[i, 0]) and math.isfinite(m.uv_left_a[i, 0]):
                e = _squared_error(inverses[s], m.points_b[i], m.sigmas_b[i], m.uv_left_a[i], lens)
                cost += e if e < limit else limit
            if cost >= lowest:
                break
        if cost < lowest:
            best, lowest = s, cost
    return best


@njit
def consistent(t, back, m, lens, limit):
    """(N,): the squared error over its variance is below `limit` from a to b, and from b to a where that is known.

    Args:
        t, back: (4, 4) b_T_a and its inverse. m: Matches. lens: of the left camera.
    """
    out = np.zeros(m.points_a.shape[0], np.bool_)
    for i in range(out.shape[0]):
        out[i] = _squared_error(t, m.points_a[i], m.sigmas_a[i], m.uv_left_b[i], lens) < limit
        if out[i] and math.isfinite(m.points_b[i, 0]) and math.isfinite(m.uv_left_a[i, 0]):
            out[i] = _squared_error(back, m.points_b[i], m.sigmas_b[i], m.uv_left_a[i], lens) < limit
    return out


@njit
def add_normal_equations(b_T_source, camera_T_source, turn, points, sigmas, uv, use, lens, hessian, gradient):
    """Adds what one image tells about exp(xi) @ b_T_a, of points that the other camera measured.

    Args:
        b_T_source, camera_T_source: (4, 4) from the points' frame into b, and into the image's camera.
        turn: its upper left (3, 3) are the derivative of a point in the image's camera by the point in b.
        points, sigmas, uv, use: (N, 3), (N,) metres along the ray, (N, 2) px, (N,); NaN where unknown.
        hessian, gradient: (6, 6), (6,).
    """
    j = np.empty((2, 6))
    for i in range(points.shape[0]):
        if not use[i] or not math.isfinite(points[i, 0]) or not math.isfinite(uv[i, 0]):
            continue
        (e0, e1), (w00, w01, w11), rows = _reprojection(camera_T_source, points[i], sigmas[i], uv[i], lens)
        if not math.isfinite(e0):
            continue
        b0, b1, b2 = transform_point(b_T_source, points[i, 0], points[i, 1], points[i, 2])
        for k, (a0, a1, a2) in enumerate(rows):
            g0 = a0 * turn[0, 0] + a1 * turn[1, 0] + a2 * turn[2, 0]
            g1 = a0 * turn[0, 1] + a1 * turn[1, 1] + a2 * turn[2, 1]
            g2 = a0 * turn[0, 2] + a1 * turn[1, 2] + a2 * turn[2, 2]
            j[k, 0], j[k, 1], j[k, 2] = g0, g1, g2
            j[k, 3], j[k, 4], j[k, 5] = b1 * g2 - b2 * g1, b2 * g0 - b0 * g2, b0 * g1 - b1 * g0
        f0, f1 = w00 * e0 + w01 * e1, w01 * e0 + w11 * e1
        for k in range(6):
            h0, h1 = w00 * j[0, k] + w01 * j[1, k], w01 * j[0, k] + w11 * j[1, k]
            gradient[k] += j[0, k] * f0 + j[1, k] * f1
            for m in range(6):
                hessian[k, m] += h0 * j[0, m] + h1 * j[1, m]
