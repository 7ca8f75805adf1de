"""Compiled inner loops of bundle adjustment (mapping/bundle.py).

One observation costs one symmetric (3, 3) matrix and one (3,) vector. With p the point in the camera, J the stacked
derivative of the observed pixels by p and r their residuals, robust weights included,

    A = J^T J,   g = J^T r.

The pose is perturbed on its right, world_T_kf exp(xi) with xi = (rho, phi), hence dp = -rho + p x phi + R^T dpoint,
and every block of the normal equations follows from A, g, p and R alone: with G = [-I, skew(p)]

    H_kf = G^T A G,   H_point = R A R^T,   W = G^T A R^T,   b_kf = -G^T g,   b_point = -R g.

The Schur complement over the points is Triggs et al., Bundle adjustment: a modern synthesis (2000), section 6.1.
Observations are sorted by point. The observations of fixed keyframes are summed up in a quadratic prior of every point,
(H (6,), g (3,)) in world axes about x0: cost = g.d + d^T H d / 2 with d = x - x0.

Inner loops index arrays directly, and rows that are read together are adjacent: a view of a row costs more than the
arithmetic on it.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportCallIssue=false

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereo_sfm.geometry.kernels import inlined, njit, project_one
from stereo_sfm.geometry.se3_kernels import compose_into, exp_into, transform_point
from stereo_sfm.mapping.block_product import subtract_product
from stereo_sfm.types import F64, I64

UNPROJECTABLE = 1e6  # chi2 of a point outside the camera's field of view: without gradient, so such steps are rejected


@inlined
def _huber(chi2, delta):
    """(cost, weight) of Huber's loss on a squared, normalised residual; delta <= 0 means squares."""
    if delta <= 0.0 or chi2 <= delta * delta:
        return 0.5 * chi2, 1.0
    e = math.sqrt(chi2)
    return delta * (e - 0.5 * delta), delta / e


@inlined
def _loss(chi2, scale, redescends):
    """(cost, weight) of Cauchy's loss of a scale in sigmas if it redescends, else of Huber's with that threshold."""
    if not redescends:
        return _huber(chi2, scale)
    scale2 = scale * scale
    return 0.5 * scale2 * math.log(1.0 + chi2 / scale2), 1.0 / (1.0 + chi2 / scale2)


@inlined
def _project(model, params, x, y, z, u_obs, v_obs, w):
    """Derivatives (u by x y z, v by x y z) and residuals ru, rv of one image, scaled by w, and chi2; zeros if w is 0.

    A NaN v_obs means: only u was seen.
    """
    if not w > 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    u, v, j00, j01, j02, j10, j11, j12 = project_one(model, params, x, y, z)
    if not (math.isfinite(u) and math.isfinite(v)):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, UNPROJECTABLE
    ru = w * (u - u_obs)
    if not math.isfinite(v_obs):
        return w * j00, w * j01, w * j02, 0.0, 0.0, 0.0, ru, 0.0, ru * ru
    rv = w * (v - v_obs)
    return w * j00, w * j01, w * j02, w * j10, w * j11, w * j12, ru, rv, ru * ru + rv * rv


class Rows(NamedTuple):
    """Observations, in columns."""

    kf: I64  # (M,)
    pt: I64  # (M,)
    uv_left: F64  # (M, 2) px
    uv_right: F64  # (M, 2) px
    weights: F64  # (M, 2) 1/px of either image, 0 where not observed


@njit
def linearize(own, rot, pos, points, rows, trust, use, limit, cameras, scale, redescends, joint, out):
    """Residuals and their quadratic model at one state.

    What a depth camera measures beside the pixel is the disparity, u of the right image less that of the left: the
    computed right pixel has the left one's error.

    Args:
        own: (N,) those of the rows. rot, pos: (K, 3, 3), (K, 3) of world_T_kf. points: (P, 3) world. rows: Rows.
        cameras: StereoCameras.
        trust: (P,) factor of the loss of a point's right images, if joint of both.
        use: (M, 2) images that count. limit: if above 0, `use` is set here to those whose chi2 is not above it.
        scale, redescends: of the loss, see `_loss`. joint: one loss over both images instead of one each.
        out: (A (M, 6) upper triangle, g (M, 3), p (M, 3), chi2 (M, 2)), overwritten; chi2 also of images that do not
            count.

    Returns:
        The robust cost, sum of rho(chi2) with rho(e^2) = e^2 / 2 near zero.
    """
    obs_kf, obs_pt, uv_left, uv_right, weights = rows
    a, g, p, chi2 = out
    t = cameras.right_T_left
    r00, r01, r02, r10, r11, r12 = t[0, 0], t[0, 1], t[0, 2], t[1, 0], t[1, 1], t[1, 2]
    r20, r21, r22 = t[2, 0], t[2, 1], t[2, 2]
    cost = 0.0
    for o in own:
        k, i = obs_kf[o], obs_pt[o]
        d0, d1, d2 = points[i, 0] - pos[k, 0], points[i, 1] - pos[k, 1], points[i, 2] - pos[k, 2]
        p0 = rot[k, 0, 0] * d0 + rot[k, 1, 0] * d1 + rot[k, 2, 0] * d2
        p1 = rot[k, 0, 1] * d0 + rot[k, 1, 1] * d1 + rot[k, 2, 1] * d2
        p2 = rot[k, 0, 2] * d0 + rot[k, 1, 2] * d1 + rot[k, 2, 2] * d2
        p[o, 0], p[o, 1], p[o, 2] = p0, p1, p2
        x0, x1, x2, y0, y1, y2, ru, rv, chi_l = _project(
            cameras.model_l, cameras.params_l, p0, p1, p2, uv_left[o, 0], uv_left[o, 1], weights[o, 0]
        )
        q0, q1, q2 = transform_point(t, p0, p1, p2)
        u0, u1, u2, v0, v1, v2, su, sv, chi_r = _project(
            cameras.model_r, cameras.params_r, q0, q1, q2, uv_right[o, 0], uv_right[o, 1], weights[o, 1]
        )
        u0, u1, u2 = u0 * r00 + u1 * r10 + u2 * r20, u0 * r01 + u1 * r11 + u2 * r21, u0 * r02 + u1 * r12 + u2 * r22
        v0, v1, v2 = v0 * r00 + v1 * r10 + v2 * r20, v0 * r01 + v1 * r11 + v2 * r21, v0 * r02 + v1 * r12 + v2 * r22
        if cameras.depth and weights[o, 0] > 0 and max(chi_l, chi_r) < UNPROJECTABLE:
            s = weights[o, 1] / weights[o, 0]
            u0, u1, u2, su = u0 - s * x0, u1 - s * x1, u2 - s * x2, su - s * ru
            v0 = v1 = v2 = sv = 0.0
            chi_r = su * su
        chi2[o, 0], chi2[o, 1] = chi_l, chi_r
        if limit > 0:
            use[o, 0], use[o, 1] = weights[o, 0] > 0 and chi_l <= limit, weights[o, 1] > 0 and chi_r <= limit
        chi_l, chi_r = chi_l if use[o, 0] else 0.0, chi_r if use[o, 1] else 0.0
        if joint:
            rho, s_l = _loss(chi_l + chi_r, scale, redescends)
            s_l *= trust[i]
            s_r = s_l
            cost += trust[i] * rho
        else:
            rho_l, s_l = _loss(chi_l, scale, redescends)
            rho_r, s_r = _loss(chi_r, scale, redescends)
            s_r *= trust[i]
            cost += rho_l + trust[i] * rho_r
        s_l, s_r = s_l if use[o, 0] else 0.0, s_r if use[o, 1] else 0.0
        a[o, 0] = s_l * (x0 * x0 + y0 * y0) + s_r * (u0 * u0 + v0 * v0)
        a[o, 1] = s_l * (x0 * x1 + y0 * y1) + s_r * (u0 * u1 + v0 * v1)
        a[o, 2] = s_l * (x0 * x2 + y0 * y2) + s_r * (u0 * u2 + v0 * v2)
        a[o, 3] = s_l * (x1 * x1 + y1 * y1) + s_r * (u1 * u1 + v1 * v1)
        a[o, 4] = s_l * (x1 * x2 + y1 * y2) + s_r * (u1 * u2 + v1 * v2)
        a[o, 5] = s_l * (x2 * x2 + y2 * y2) + s_r * (u2 * u2 + v2 * v2)
        g[o, 0] = s_l * (x0 * ru + y0 * rv) + s_r * (u0 * su + v0 * sv)
        g[o, 1] = s_l * (x1 * ru + y1 * rv) + s_r * (u1 * su + v1 * sv)
        g[o, 2] = s_l * (x2 * ru + y2 * rv) + s_r * (u2 * su + v2 * sv)
    return cost


@njit
def add_disparity_errors(own, rot, pos, points, rows, use, cameras, total, information):
    """Add, by point, the weighted disparity errors of its observations in both images.

    The error is the right pixel's residual less the left one's, along the epipolar curve, positive towards nearer.

    Args:
        own, rot, pos, points, rows, use, cameras: as of `linearize`.
        total (P,), information (P,): the sums of weight^2 times error, and of weight^2, are added.
    """
    obs_kf, obs_pt, uv_left, uv_right, weights = rows
    t = cameras.right_T_left
    for o in own:
        if not (use[o, 0] and use[o, 1]):
            continue
        k, i = obs_kf[o], obs_pt[o]
        d0, d1, d2 = points[i, 0] - pos[k, 0], points[i, 1] - pos[k, 1], points[i, 2] - pos[k, 2]
        p0 = rot[k, 0, 0] * d0 + rot[k, 1, 0] * d1 + rot[k, 2, 0] * d2
        p1 = rot[k, 0, 1] * d0 + rot[k, 1, 1] * d1 + rot[k, 2, 1] * d2
        p2 = rot[k, 0, 2] * d0 + rot[k, 1, 2] * d1 + rot[k, 2, 2] * d2
        left = project_one(cameras.model_l, cameras.params_l, p0, p1, p2)
        right = project_one(cameras.model_r, cameras.params_r, *transform_point(t, p0, p1, p2))
        if not (math.isfinite(left[0]) and math.isfinite(right[0])):
            continue
        du = right[2] * t[0, 3] + right[3] * t[1, 3] + right[4] * t[2, 3]
        error = du * (uv_right[o, 0] - right[0] - uv_left[o, 0] + left[0])
        square = du * du
        if math.isfinite(uv_right[o, 1]):
            dv = right[5] * t[0, 3] + right[6] * t[1, 3] + right[7] * t[2, 3]
            error += dv * (uv_right[o, 1] - right[1] - uv_left[o, 1] + left[1])
            square += dv * dv
        if square > 0:
            w = weights[o, 1] * weights[o, 1]
            total[i] += w * error / math.sqrt(square)
            information[i] += w


@inlined
def _times(a, o, x, y, z):
    """The symmetric matrix o of a, upper triangles, times a vector."""
    return (
        a[o, 0] * x + a[o, 1] * y + a[o, 2] * z,
        a[o, 1] * x + a[o, 3] * y + a[o, 4] * z,
        a[o, 2] * x + a[o, 4] * y + a[o, 5] * z,
    )


@inlined
def _by_pose(x, y, z, p0, p1, p2):
    """G^T times a vector in the camera, of a point p there: skew(p)^T v = v x p."""
    return -x, -y, -z, y * p2 - z * p1, z * p0 - x * p2, x * p1 - y * p0


@inlined
def _add(row, v):
    """Adds six numbers to a row."""
    row[0], row[1], row[2] = row[0] + v[0], row[1] + v[1], row[2] + v[2]
    row[3], row[4], row[5] = row[3] + v[3], row[4] + v[4], row[5] + v[5]


@inlined
def _cross_block(a, p, r, o, k, w, n):
    """W^T = (G^T A R^T)^T of observation o in keyframe k into w[n] (18,): column by column, six entries each."""
    for c in range(3):
        x, y, z = _times(a, o, r[k, c, 0], r[k, c, 1], r[k, c, 2])
        (
            w[n, 6 * c], w[n, 6 * c + 1], w[n, 6 * c + 2], w[n, 6 * c + 3], w[n, 6 * c + 4], w[n, 6 * c + 5],
        ) = _by_pose(x, y, z, p[o, 0], p[o, 1], p[o, 2])  # fmt: skip


@njit
def pose_blocks(obs_kf, free, lin, h, b):
    """Adds G^T A G and -G^T g of every observation of a free keyframe to h (F, 6, 6) and b (F, 6)."""
    a, g, p, _ = lin
    for o in range(obs_kf.shape[0]):
        c = free[obs_kf[o]]
        if c < 0:
            continue
        p0, p1, p2 = p[o, 0], p[o, 1], p[o, 2]
        x = _by_pose(a[o, 0], a[o, 1], a[o, 2], p0, p1, p2)  # columns of G^T A
        y = _by_pose(a[o, 1], a[o, 3], a[o, 4], p0, p1, p2)
        z = _by_pose(a[o, 2], a[o, 4], a[o, 5], p0, p1, p2)
        _add(h[c, 0], _by_pose(x[0], y[0], z[0], p0, p1, p2))
        _add(h[c, 1], _by_pose(x[1], y[1], z[1], p0, p1, p2))
        _add(h[c, 2], _by_pose(x[2], y[2], z[2], p0, p1, p2))
        _add(h[c, 3], _by_pose(x[3], y[3], z[3], p0, p1, p2))
        _add(h[c, 4], _by_pose(x[4], y[4], z[4], p0, p1, p2))
        _add(h[c, 5], _by_pose(x[5], y[5], z[5], p0, p1, p2))
        _add(b[c], _by_pose(-g[o, 0], -g[o, 1], -g[o, 2], p0, p1, p2))
    for c in range(h.shape[0]):
        for i in range(6):
            for k in range(i + 1, 6):
                h[c, k, i] = h[c, i, k]


@njit
def move_poses(rows, xi, rot, pos):
    """world_T_kf exp(xi) of some rows of rot (K, 3, 3) and pos (K, 3), in place; xi (F, 6)."""
    before, delta, after = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4))
    for i in range(rows.shape[0]):
        k = rows[i]
        for r in range(3):
            before[r, 0], before[r, 1], before[r, 2], before[r, 3] = rot[k, r, 0], rot[k, r, 1], rot[k, r, 2], pos[k, r]
        exp_into(xi[i], 1.0, delta)
        compose_into(before, delta, after)
        for r in range(3):
            rot[k, r, 0], rot[k, r, 1], rot[k, r, 2], pos[k, r] = after[r, 0], after[r, 1], after[r, 2], after[r, 3]


@njit
def sum_up(starts, obs_kf, rot, lin, h, g):
    """Adds up the quadratic models of every point: R A R^T to h (P, 6), upper triangle, and R g to g (P, 3)."""
    a_all, g_all, _, _ = lin
    for pt in range(starts.shape[0] - 1):
        for o in range(starts[pt], starts[pt + 1]):
            k, n = obs_kf[o], 0
            for i in range(3):
                r0, r1, r2 = rot[k, i, 0], rot[k, i, 1], rot[k, i, 2]
                x, y, z = _times(a_all, o, r0, r1, r2)
                for j in range(i, 3):
                    h[pt, n] += rot[k, j, 0] * x + rot[k, j, 1] * y + rot[k, j, 2] * z
                    n += 1
                g[pt, i] += r0 * g_all[o, 0] + r1 * g_all[o, 1] + r2 * g_all[o, 2]


@njit
def prior_cost(points, x0, h, g):
    """The cost of the priors at the points."""
    cost = 0.0
    for i in range(points.shape[0]):
        d0, d1, d2 = points[i, 0] - x0[i, 0], points[i, 1] - x0[i, 1], points[i, 2] - x0[i, 2]
        e0, e1, e2 = _times(h, i, d0, d1, d2)
        cost += (g[i, 0] + 0.5 * e0) * d0 + (g[i, 1] + 0.5 * e1) * d1 + (g[i, 2] + 0.5 * e2) * d2
    return cost


@njit
def point_blocks(points, x0, q, prior_g, damping, h, g):
    """Turns the sums of the moving keyframes, h (P, 6) and g (P, 3), into (H_point + damping diag)^-1 and b_point.

    Both are zero for a point whose block is singular: nothing sees it.

    Args:
        x0, q, prior_g: the priors' (P, 3), H (P, 6) and g (P, 3).
    """
    for i in range(points.shape[0]):
        d0, d1, d2 = points[i, 0] - x0[i, 0], points[i, 1] - x0[i, 1], points[i, 2] - x0[i, 2]
        q0, q1, q2, q3, q4, q5 = q[i, 0], q[i, 1], q[i, 2], q[i, 3], q[i, 4], q[i, 5]
        g[i, 0] = -g[i, 0] - prior_g[i, 0] - q0 * d0 - q1 * d1 - q2 * d2
        g[i, 1] = -g[i, 1] - prior_g[i, 1] - q1 * d0 - q3 * d1 - q4 * d2
        g[i, 2] = -g[i, 2] - prior_g[i, 2] - q2 * d0 - q4 * d1 - q5 * d2
        h00, h01, h02 = h[i, 0] + q0, h[i, 1] + q1, h[i, 2] + q2
        h11, h12, h22 = h[i, 3] + q3, h[i, 4] + q4, h[i, 5] + q5
        scale = (h00 + h11 + h22) / 3.0
        h00 += damping * h00
        h11 += damping * h11
        h22 += damping * h22
        c00 = h11 * h22 - h12 * h12
        c01 = h02 * h12 - h01 * h22
        c02 = h01 * h12 - h02 * h11
        det = h00 * c00 + h01 * c01 + h02 * c02
        if not det > 1e-14 * scale * scale * scale:
            h[i, 0] = h[i, 1] = h[i, 2] = h[i, 3] = h[i, 4] = h[i, 5] = 0.0
            g[i, 0] = g[i, 1] = g[i, 2] = 0.0
            continue
        inv = 1.0 / det
        h[i, 0], h[i, 1], h[i, 2] = c00 * inv, c01 * inv, c02 * inv
        h[i, 3], h[i, 4] = (h00 * h22 - h02 * h02) * inv, (h01 * h02 - h00 * h12) * inv
        h[i, 5] = (h00 * h11 - h01 * h01) * inv


@njit
def list_pairs(starts, obs_kf, free, n_free, keys):
    """Fills keys with row * F + column (row >= column) of every pair of free keyframes, the diagonal included, that a
    point joins, in the order in which `reduce` visits them."""
    i = 0
    for pt in range(starts.shape[0] - 1):
        for o in range(starts[pt], starts[pt + 1]):
            c = free[obs_kf[o]]
            if c < 0:
                continue
            for q in range(starts[pt], o + 1):
                d = free[obs_kf[q]]
                if d >= 0:
                    keys[i] = max(c, d) * n_free + min(c, d)
                    i += 1


@njit
def reduce(starts, obs_kf, free, rot, lin, h_inv, b_point, most, blocks, slots, b):
    """Subtracts W H_point^-1 W^T and W H_point^-1 b_point of every point from the reduced system.

    Args:
        starts: (P + 1,) first observation of every point. free: (K,) row of a keyframe, -1 when it is fixed.
        h_inv, b_point: (P, 6), (P, 3), see `point_blocks`. most: the largest number of free keyframes of one point.
        blocks: (B, 6, 6) lower blocks of the reduced matrix, changed. slots: block of every pair in `list_pairs` order.
        b: (F, 6), changed.
    """
    a_all, _, p_all, _ = lin
    w = np.zeros((max(most, 1), 18))
    row = np.zeros(max(most, 1), np.int64)
    y = np.zeros((1, 18))
    i = 0
    for pt in range(starts.shape[0] - 1):
        n = 0
        for o in range(starts[pt], starts[pt + 1]):
            c = free[obs_kf[o]]
            if c >= 0:
                _cross_block(a_all, p_all, rot, o, obs_kf[o], w, n)
                row[n] = c
                n += 1
        b0, b1, b2 = b_point[pt, 0], b_point[pt, 1], b_point[pt, 2]
        for m in range(n):
            c = row[m]
            for k in range(6):
                y0, y1, y2 = _times(h_inv, pt, w[m, k], w[m, 6 + k], w[m, 12 + k])
                y[0, k], y[0, 6 + k], y[0, 12 + k] = y0, y1, y2
                b[c, k] -= y0 * b0 + y1 * b1 + y2 * b2
            for q in range(m + 1):
                if c >= row[q]:
                    subtract_product(y, 0, w, q, blocks, slots[i])
                if c < row[q] or (c == row[q] and m != q):  # transposed; both where one keyframe sees the point twice
                    subtract_product(w, q, y, 0, blocks, slots[i])
                i += 1


@njit
def point_steps(starts, obs_kf, free, rot, lin, h, b_point, step, points, out):
    """Back substitution: out = points + h (b_point - W^T step) with step (F, 6), h = H_point^-1."""
    a, _, p, _ = lin
    for pt in range(starts.shape[0] - 1):
        b0, b1, b2 = b_point[pt, 0], b_point[pt, 1], b_point[pt, 2]
        for o in range(starts[pt], starts[pt + 1]):
            k = obs_kf[o]
            c = free[k]
            if c < 0:
                continue
            v0 = p[o, 1] * step[c, 5] - p[o, 2] * step[c, 4] - step[c, 0]
            v1 = p[o, 2] * step[c, 3] - p[o, 0] * step[c, 5] - step[c, 1]
            v2 = p[o, 0] * step[c, 4] - p[o, 1] * step[c, 3] - step[c, 2]
            u0, u1, u2 = _times(a, o, v0, v1, v2)
            b0 -= rot[k, 0, 0] * u0 + rot[k, 0, 1] * u1 + rot[k, 0, 2] * u2
            b1 -= rot[k, 1, 0] * u0 + rot[k, 1, 1] * u1 + rot[k, 1, 2] * u2
            b2 -= rot[k, 2, 0] * u0 + rot[k, 2, 1] * u1 + rot[k, 2, 2] * u2
        out[pt, 0] = points[pt, 0] + h[pt, 0] * b0 + h[pt, 1] * b1 + h[pt, 2] * b2
        out[pt, 1] = points[pt, 1] + h[pt, 1] * b0 + h[pt, 3] * b1 + h[pt, 4] * b2
        out[pt, 2] = points[pt, 2] + h[pt, 2] * b0 + h[pt, 4] * b1 + h[pt, 5] * b2
