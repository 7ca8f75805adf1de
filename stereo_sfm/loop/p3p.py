"""Three-point absolute pose and its RANSAC, compiled, for bearings of any camera (Persson & Nordberg, Lambda Twist,
ECCV 2018; the steps are derived anew)."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereo_sfm.geometry.kernels import KANNALA_BRANDT, inner, njit, project_one
from stereo_sfm.geometry.se3_kernels import dot
from stereo_sfm.loop.cost_bound import SLACK, fisheye_bound, make_columns
from stereo_sfm.types import F64


@inner
def _cubic_root(c3, c2, c1, c0):
    """One real root of c3 x^3 + c2 x^2 + c1 x + c0, the one where the polynomial is steepest, polished by Newton."""
    if abs(c3) < 1e-14 * (abs(c2) + abs(c1) + abs(c0)):
        if abs(c2) < 1e-14 * (abs(c1) + abs(c0)):
            return -c0 / c1
        disc = max(c1 * c1 - 4 * c2 * c0, 0.0)
        return (-c1 - math.copysign(math.sqrt(disc), c1)) / (2 * c2)
    a, b, c = c2 / c3, c1 / c3, c0 / c3
    q = (a * a - 3 * b) / 9
    r = (2 * a * a * a - 9 * a * b + 27 * c) / 54
    if r * r < q * q * q:
        theta = math.acos(max(-1.0, min(1.0, r / math.sqrt(q * q * q))))
        x = -2 * math.sqrt(q) * math.cos(theta / 3) - a / 3
    else:
        s = -math.copysign((abs(r) + math.sqrt(max(r * r - q * q * q, 0.0))) ** (1 / 3), r)
        x = s + (q / s if s != 0 else 0.0) - a / 3
    for _ in range(4):
        slope = (3 * x + 2 * a) * x + b
        if slope == 0:
            break
        x -= (((x + a) * x + b) * x + c) / slope
    return x


@njit
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inner
def _eigenvector(m, value):
    """Unit null vector of the symmetric 3x3 matrix m - value I: the largest cross product of two of its rows."""
    n = m.copy()
    for i in range(3):
        n[i, i] -= value
    x, y, z, largest = 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        cx, cy, cz = _cross(n[i], n[(i + 1) % 3])
        size = cx * cx + cy * cy + cz * cz
        if size > largest:
            x, y, z, largest = cx, cy, cz, size
    scale = 1.0 / math.sqrt(largest) if largest > 0 else 0.0
    return x * scale, y * scale, z * scale


@inner
def _det3(m):
    return dot(m[0], _cross(m[1], m[2]))


@inner
def _adjugate_trace(a, b):
    """trace(adj(a) b) for symmetric a."""
    total = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        total += (a[j, j] * a[k, k] - a[j, k] * a[k, j]) * b[i, i]
        total += 2 * (a[i, k] * a[j, k] - a[i, j] * a[k, k]) * b[i, j]
    return total


@inner
def _polish(l1, l2, l3, a12, a13, a23, b12, b13, b23):
    """Newton steps on the three distance equations."""
    for _ in range(3):
        r1 = l1 * l1 + l2 * l2 - 2 * b12 * l1 * l2 - a12
        r2 = l1 * l1 + l3 * l3 - 2 * b13 * l1 * l3 - a13
        r3 = l2 * l2 + l3 * l3 - 2 * b23 * l2 * l3 - a23
        # Columns of the Jacobian, and Cramer's rule.
        c1 = (2 * (l1 - b12 * l2), 2 * (l1 - b13 * l3), 0.0)
        c2 = (2 * (l2 - b12 * l1), 0.0, 2 * (l2 - b23 * l3))
        c3 = (0.0, 2 * (l3 - b13 * l1), 2 * (l3 - b23 * l2))
        r = (r1, r2, r3)
        det = dot(c1, _cross(c2, c3))
        if abs(det) < 1e-18:
            break
        l1 -= dot(r, _cross(c2, c3)) / det
        l2 -= dot(c1, _cross(r, c3)) / det
        l3 -= dot(c1, _cross(c2, r)) / det
    return l1, l2, l3


@njit
def p3p(points, bearings):
    """(3, 3) points of frame a and (3, 3) unit bearings of frame b -> up to four b_T_a as (4, 3, 4), and how many."""
    out = np.empty((4, 3, 4))
    y12, y13 = np.empty(3), np.empty(3)
    count = 0
    x12, x13 = points[0] - points[1], points[0] - points[2]
    x23 = points[1] - points[2]
    a12, a13, a23 = dot(x12, x12), dot(x13, x13), dot(x23, x23)
    b12, b13 = dot(bearings[0], bearings[1]), dot(bearings[0], bearings[2])
    b23 = dot(bearings[1], bearings[2])
    normal = _cross(x12, x13)
    area = dot(normal, normal)
    if area < 1e-12 * a12 * a13 or min(a12, a13, a23) < 1e-12:
        return out, 0
    d1 = np.array([[a23, -a23 * b12, 0.0], [-a23 * b12, a23 - a12, a12 * b23], [0.0, a12 * b23, -a12]])
    d2 = np.array([[a23, 0.0, -a23 * b13], [0.0, -a13, a13 * b23], [-a23 * b13, a13 * b23, a23 - a13]])
    g = _cubic_root(_det3(d2), _adjugate_trace(d2, d1), _adjugate_trace(d1, d2), _det3(d1))
    d0 = np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            d0[i, k] = d1[i, k] + g * d2[i, k]
    trace = d0[0, 0] + d0[1, 1] + d0[2, 2]
    minors = (
        d0[0, 0] * d0[1, 1] - d0[0, 1] ** 2 + d0[0, 0] * d0[2, 2] - d0[0, 2] ** 2 + d0[1, 1] * d0[2, 2] - d0[1, 2] ** 2
    )
    disc = math.sqrt(max(trace * trace - 4 * minors, 0.0))
    positive, negative = 0.5 * (trace + disc), 0.5 * (trace - disc)
    if not (positive > 0 and negative <= 0):
        return out, 0
    e1, e2 = _eigenvector(d0, positive), _eigenvector(d0, negative)
    s = math.sqrt(-negative / positive)
    # Rows of the inverse of the matrix with the columns x12, x13, normal, whose determinant is `area`.
    dual12, dual13 = _cross(x13, normal), _cross(normal, x12)
    for sign in (-1.0, 1.0):
        n0 = e1[0] + sign * s * e2[0]
        if abs(n0) < 1e-12:
            continue
        w0, w1 = -(e1[1] + sign * s * e2[1]) / n0, -(e1[2] + sign * s * e2[2]) / n0
        qa = (w1 * w1 + 1 - 2 * b13 * w1) * a23 - a13
        qb = 2 * w0 * (w1 - b13) * a23 + 2 * b23 * a13
        qc = w0 * w0 * a23 - a13
        quad = qb * qb - 4 * qa * qc
        if quad < 0 or abs(qa) < 1e-14:
            continue
        for root in (-1.0, 1.0):
            tau = (-qb + root * math.sqrt(quad)) / (2 * qa)
            ratio = w0 + w1 * tau
            size = 1 + tau * tau - 2 * b23 * tau
            if tau <= 0 or ratio <= 0 or size <= 0:
                continue
            l2 = math.sqrt(a23 / size)
            m1, m2, m3 = _polish(ratio * l2, l2, tau * l2, a12, a13, a23, b12, b13, b23)
            if not (m1 > 0 and m2 > 0 and m3 > 0):
                continue
            for i in range(3):
                y12[i] = m1 * bearings[0, i] - m2 * bearings[1, i]
                y13[i] = m1 * bearings[0, i] - m3 * bearings[2, i]
            up = _cross(y12, y13)
            for i in range(3):
                for k in range(3):
                    out[count, i, k] = (y12[i] * dual12[k] + y13[i] * dual13[k] + up[i] * normal[k]) / area
                out[count, i, 3] = m1 * bearings[0, i] - dot(out[count, i], points[0])
            count += 1
    return out, count


class Lens(NamedTuple):
    """A camera, and the noise of its pixels."""

    model: int
    params: F64
    sigma: float  # px


@inner
def squared_error(t, point, range_sigma, uv, lens):
    """Squared reprojection error over its variance: pixel noise and the point's own range uncertainty along its ray.

    `t` (3, 4) takes the point into the camera. Infinite where the camera cannot see the point.
    """
    x = t[0, 0] * point[0] + t[0, 1] * point[1] + t[0, 2] * point[2] + t[0, 3]
    y = t[1, 0] * point[0] + t[1, 1] * point[1] + t[1, 2] * point[2] + t[1, 3]
    z = t[2, 0] * point[0] + t[2, 1] * point[1] + t[2, 2] * point[2] + t[2, 3]
    u, v, j00, j01, j02, j10, j11, j12 = project_one(lens.model, lens.params, x, y, z)
    ru, rv = u - uv[0], v - uv[1]
    if not math.isfinite(ru):
        return math.inf
    length = math.sqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2) + 1e-12
    k = range_sigma / length
    rx = (t[0, 0] * point[0] + t[0, 1] * point[1] + t[0, 2] * point[2]) * k
    ry = (t[1, 0] * point[0] + t[1, 1] * point[1] + t[1, 2] * point[2]) * k
    rz = (t[2, 0] * point[0] + t[2, 1] * point[1] + t[2, 2] * point[2]) * k
    du = j00 * rx + j01 * ry + j02 * rz
    dv = j10 * rx + j11 * ry + j12 * rz
    s2 = lens.sigma * lens.sigma
    along = ru * du + rv * dv
    return (ru * ru + rv * rv - along * along / (s2 + du * du + dv * dv)) / s2


@inner
def inverse34(t):
    """Inverse of a rigid (3, 4) transform."""
    out = np.empty((3, 4))
    for r in range(3):
        for c in range(3):
            out[r, c] = t[c, r]
        out[r, 3] = -(t[0, r] * t[0, 3] + t[1, r] * t[1, 3] + t[2, r] * t[2, 3])
    return out


@inner
def _cost(t, m, lens, limit, worst):
    """Truncated cost over both directions (MSAC); stops early once it is no better than `worst`."""
    back = inverse34(t)
    total = 0.0
    for i in range(m.points_a.shape[0]):
        total += min(squared_error(t, m.points_a[i], m.sigmas_a[i], m.uv_left_b[i], lens), limit)
        if math.isfinite(m.points_b[i, 0]) and math.isfinite(m.uv_left_a[i, 0]):
            total += min(squared_error(back, m.points_b[i], m.sigmas_b[i], m.uv_left_a[i], lens), limit)
        if total >= worst:
            return total
    return total


@njit
def ransac(m, bearings, lens, limit, samples, confidence):
    """Best b_T_a over the given samples (S, 3) of rows, stopping when `confidence` is reached.

    Args:
        m: Matches. bearings: (N, 3) unit, of their left pixels in b. lens: of the left camera. limit: of an error.

    Returns:
        (3, 4) transform, its cost (infinite when there is none).
    """
    ahead, back = make_columns(m.points_a, m.sigmas_a, m.uv_left_b), make_columns(m.points_b, m.sigmas_b, m.uv_left_a)
    best = np.zeros((3, 4))
    three, rays = np.empty((3, 3)), np.empty((3, 3))
    lowest = math.inf
    needed = samples.shape[0]
    for s in range(samples.shape[0]):
        if s >= needed:
            break
        for i in range(3):
            for c in range(3):
                three[i, c], rays[i, c] = m.points_a[samples[s, i], c], bearings[samples[s, i], c]
        solutions, count = p3p(three, rays)
        for k in range(count):
            t = solutions[k]
            if lens.model == KANNALA_BRANDT:
                bound = fisheye_bound(t, ahead, lens.params, lens.sigma, limit)
                if bound + fisheye_bound(inverse34(t), back, lens.params, lens.sigma, limit) > lowest + SLACK:
                    continue
            cost = _cost(t, m, lens, limit, lowest)
            if cost < lowest:
                lowest = cost
                best = t.copy()
                inside = 0
                for i in range(m.points_a.shape[0]):
                    e = squared_error(t, m.points_a[i], m.sigmas_a[i], m.uv_left_b[i], lens)
                    inside += 1 if e < limit else 0
                w = inside / m.points_a.shape[0]
                miss = 1 - w * w * w
                if miss <= 0:
                    needed = s + 1
                elif miss < 1:
                    needed = min(needed, max(20, int(math.log(1 - confidence) / math.log(miss)) + 1))
    return best, lowest
