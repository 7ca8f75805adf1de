"""Compiled inner loops of bundle adjustment (mapping/bundle.py).

One observation costs one symmetric (3, 3) matrix and one (3,) vector. With p the point in the camera, J the stacked
derivative of the observed pixels by p and r their residuals, robust weights included,

    A = J^T J,   g = J^T r.

The pose is perturbed on its right, world_T_kf exp(xi) with xi = (rho, phi), hence dp = -rho + p x phi + R^T dpoint,
and every block of the normal equations follows from A, g, p and R alone: with G = [-I, skew(p)]

    H_kf = G^T A G,   H_point = R A R^T,   W = G^T A R^T,   b_kf = -G^T g,   b_point = -R g.

The Schur complement over the points is Triggs et al., Bundle adjustment: a modern synthesis (2000), section 6.1.
Observations are sorted by point. `weights` (M, 2) is 1/sigma of either eye, 0 where that eye is not used.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.kernels import njit, project_one

UNPROJECTABLE = 1e6  # chi2 of an observation whose point left the camera's field: no gradient, steps there are refused


@njit
def _huber(chi2, delta):
    """(cost, weight) of Huber's loss on a squared, normalised residual; delta <= 0 means squares."""
    if delta <= 0.0 or chi2 <= delta * delta:
        return 0.5 * chi2, 1.0
    e = math.sqrt(chi2)
    return delta * (e - 0.5 * delta), delta / e


@njit
def _eye(model, params, x, y, z, u_obs, v_obs, w, j):
    """Residual of one eye, scaled by w. Fills j (2, 3); returns ru, rv, chi2. A NaN v_obs means: only u was seen."""
    u, v, j00, j01, j02, j10, j11, j12 = project_one(model, params, x, y, z)
    if not (math.isfinite(u) and math.isfinite(v)):
        j[:] = 0.0
        return 0.0, 0.0, UNPROJECTABLE
    j[0, 0], j[0, 1], j[0, 2] = w * j00, w * j01, w * j02
    ru = w * (u - u_obs)
    if math.isfinite(v_obs):
        rv = w * (v - v_obs)
        j[1, 0], j[1, 1], j[1, 2] = w * j10, w * j11, w * j12
    else:
        rv = 0.0
        j[1, :] = 0.0
    return ru, rv, ru * ru + rv * rv


@njit
def _add_eye(a, g, j, ru, rv, w):
    """A += w J^T J, g += w J^T r."""
    k = 0
    for i in range(3):
        g[i] += w * (j[0, i] * ru + j[1, i] * rv)
        for m in range(i, 3):
            a[k] += w * (j[0, i] * j[0, m] + j[1, i] * j[1, m])
            k += 1


@njit
def linearize(rot, pos, points, obs_kf, obs_pt, uv_left, uv_right, weights, cams, right_r, right_t, delta, joint, out):
    """Residuals and their quadratic model at one state.

    Args:
        rot, pos: (K, 3, 3), (K, 3) of world_T_kf. points: (P, 3) world.
        obs_kf, obs_pt: (M,). uv_left, uv_right: (M, 2) px. weights: (M, 2) 1/px.
        cams: (left model, left params, right model, right params). right_r, right_t: right_T_left.
        delta: Huber's threshold in sigmas. joint: one loss over both eyes instead of one each.
        out: (A (M, 6) upper triangle, g (M, 3), p (M, 3), chi2 (M, 2)), overwritten.

    Returns:
        The robust cost, sum of rho(chi2) with rho(e^2) = e^2 / 2 near zero.
    """
    left_model, left_params, right_model, right_params = cams
    a_out, g_out, p_out, chi2_out = out
    jl = np.zeros((2, 3))
    jr = np.zeros((2, 3))
    jc = np.zeros((2, 3))
    cost = 0.0
    for o in range(obs_kf.shape[0]):
        r, t, x = rot[obs_kf[o]], pos[obs_kf[o]], points[obs_pt[o]]
        d0, d1, d2 = x[0] - t[0], x[1] - t[1], x[2] - t[2]
        p0 = r[0, 0] * d0 + r[1, 0] * d1 + r[2, 0] * d2
        p1 = r[0, 1] * d0 + r[1, 1] * d1 + r[2, 1] * d2
        p2 = r[0, 2] * d0 + r[1, 2] * d1 + r[2, 2] * d2
        p_out[o, 0], p_out[o, 1], p_out[o, 2] = p0, p1, p2
        lu = lv = ru = rv = chi_l = chi_r = 0.0
        w_l, w_r = weights[o, 0], weights[o, 1]
        if w_l > 0:
            lu, lv, chi_l = _eye(left_model, left_params, p0, p1, p2, uv_left[o, 0], uv_left[o, 1], w_l, jl)
        if w_r > 0:
            q0 = right_r[0, 0] * p0 + right_r[0, 1] * p1 + right_r[0, 2] * p2 + right_t[0]
            q1 = right_r[1, 0] * p0 + right_r[1, 1] * p1 + right_r[1, 2] * p2 + right_t[1]
            q2 = right_r[2, 0] * p0 + right_r[2, 1] * p1 + right_r[2, 2] * p2 + right_t[2]
            ru, rv, chi_r = _eye(right_model, right_params, q0, q1, q2, uv_right[o, 0], uv_right[o, 1], w_r, jc)
            for i in range(2):
                for k in range(3):
                    jr[i, k] = jc[i, 0] * right_r[0, k] + jc[i, 1] * right_r[1, k] + jc[i, 2] * right_r[2, k]
        chi2_out[o, 0], chi2_out[o, 1] = chi_l, chi_r
        if joint:
            rho, s_l = _huber(chi_l + chi_r, delta)
            s_r = s_l
            cost += rho
        else:
            rho_l, s_l = _huber(chi_l, delta)
            rho_r, s_r = _huber(chi_r, delta)
            cost += rho_l + rho_r
        a, g = a_out[o], g_out[o]
        a[:] = 0.0
        g[:] = 0.0
        if w_l > 0 and chi_l < UNPROJECTABLE:
            _add_eye(a, g, jl, lu, lv, s_l)
        if w_r > 0 and chi_r < UNPROJECTABLE:
            _add_eye(a, g, jr, ru, rv, s_r)
    return cost


@njit
def _cross_blocks(a, p, r, ar, w):
    """AR = A R^T (3, 3) and W = G^T A R^T (6, 3) of one observation."""
    for k in range(3):
        ar[0, k] = a[0] * r[k, 0] + a[1] * r[k, 1] + a[2] * r[k, 2]
        ar[1, k] = a[1] * r[k, 0] + a[3] * r[k, 1] + a[4] * r[k, 2]
        ar[2, k] = a[2] * r[k, 0] + a[4] * r[k, 1] + a[5] * r[k, 2]
        w[0, k], w[1, k], w[2, k] = -ar[0, k], -ar[1, k], -ar[2, k]
        # skew(p)^T v = v x p = -p x v
        w[3, k] = ar[1, k] * p[2] - ar[2, k] * p[1]
        w[4, k] = ar[2, k] * p[0] - ar[0, k] * p[2]
        w[5, k] = ar[0, k] * p[1] - ar[1, k] * p[0]


@njit
def pose_blocks(obs_kf, free, lin, h, b):
    """Adds G^T A G and -G^T g of every observation of a free keyframe to h (F, 6, 6) and b (F, 6)."""
    a_all, g_all, p_all, _ = lin
    for o in range(obs_kf.shape[0]):
        c = free[obs_kf[o]]
        if c < 0:
            continue
        a, g, p = a_all[o], g_all[o], p_all[o]
        p0, p1, p2 = p[0], p[1], p[2]
        hc, bc = h[c], b[c]
        bc[0] += g[0]
        bc[1] += g[1]
        bc[2] += g[2]
        bc[3] -= g[1] * p2 - g[2] * p1
        bc[4] -= g[2] * p0 - g[0] * p2
        bc[5] -= g[0] * p1 - g[1] * p0
        # M = A skew(p): columns A (e_k x ...), skew(p) = [[0, -p2, p1], [p2, 0, -p0], [-p1, p0, 0]]
        rows = ((a[0], a[1], a[2]), (a[1], a[3], a[4]), (a[2], a[4], a[5]))
        m00, m01, m02 = _row_times_skew(rows[0], p0, p1, p2)
        m10, m11, m12 = _row_times_skew(rows[1], p0, p1, p2)
        m20, m21, m22 = _row_times_skew(rows[2], p0, p1, p2)
        hc[0, 0] += a[0]
        hc[1, 0] += a[1]
        hc[1, 1] += a[3]
        hc[2, 0] += a[2]
        hc[2, 1] += a[4]
        hc[2, 2] += a[5]
        hc[3, 0] -= m00
        hc[3, 1] -= m10
        hc[3, 2] -= m20
        hc[4, 0] -= m01
        hc[4, 1] -= m11
        hc[4, 2] -= m21
        hc[5, 0] -= m02
        hc[5, 1] -= m12
        hc[5, 2] -= m22
        # skew(p)^T M, lower triangle
        hc[3, 3] += p2 * m10 - p1 * m20
        hc[4, 3] += p0 * m20 - p2 * m00
        hc[4, 4] += p0 * m21 - p2 * m01
        hc[5, 3] += p1 * m00 - p0 * m10
        hc[5, 4] += p1 * m01 - p0 * m11
        hc[5, 5] += p1 * m02 - p0 * m12
    for c in range(h.shape[0]):
        for i in range(6):
            for k in range(i + 1, 6):
                h[c, i, k] = h[c, k, i]


@njit
def _row_times_skew(row, p0, p1, p2):
    return row[1] * p2 - row[2] * p1, row[2] * p0 - row[0] * p2, row[0] * p1 - row[1] * p0


@njit
def _point_block(first, last, obs_kf, rot, lin, damping, hinv, b):
    """(H_point + damping diag)^-1 into hinv (3, 3) and b_point into b (3,). False where nothing sees it."""
    a_all, g_all, _, _ = lin
    h00 = h01 = h02 = h11 = h12 = h22 = 0.0
    b[:] = 0.0
    for o in range(first, last):
        a, g, r = a_all[o], g_all[o], rot[obs_kf[o]]
        for i in range(3):
            b[i] -= r[i, 0] * g[0] + r[i, 1] * g[1] + r[i, 2] * g[2]
        x0 = a[0] * r[0, 0] + a[1] * r[0, 1] + a[2] * r[0, 2]
        x1 = a[1] * r[0, 0] + a[3] * r[0, 1] + a[4] * r[0, 2]
        x2 = a[2] * r[0, 0] + a[4] * r[0, 1] + a[5] * r[0, 2]
        h00 += r[0, 0] * x0 + r[0, 1] * x1 + r[0, 2] * x2
        h01 += r[1, 0] * x0 + r[1, 1] * x1 + r[1, 2] * x2
        h02 += r[2, 0] * x0 + r[2, 1] * x1 + r[2, 2] * x2
        y0 = a[0] * r[1, 0] + a[1] * r[1, 1] + a[2] * r[1, 2]
        y1 = a[1] * r[1, 0] + a[3] * r[1, 1] + a[4] * r[1, 2]
        y2 = a[2] * r[1, 0] + a[4] * r[1, 1] + a[5] * r[1, 2]
        h11 += r[1, 0] * y0 + r[1, 1] * y1 + r[1, 2] * y2
        h12 += r[2, 0] * y0 + r[2, 1] * y1 + r[2, 2] * y2
        z0 = a[0] * r[2, 0] + a[1] * r[2, 1] + a[2] * r[2, 2]
        z1 = a[1] * r[2, 0] + a[3] * r[2, 1] + a[4] * r[2, 2]
        z2 = a[2] * r[2, 0] + a[4] * r[2, 1] + a[5] * r[2, 2]
        h22 += r[2, 0] * z0 + r[2, 1] * z1 + r[2, 2] * z2
    scale = (h00 + h11 + h22) / 3.0
    h00 += damping * h00
    h11 += damping * h11
    h22 += damping * h22
    c00 = h11 * h22 - h12 * h12
    c01 = h02 * h12 - h01 * h22
    c02 = h01 * h12 - h02 * h11
    det = h00 * c00 + h01 * c01 + h02 * c02
    if not det > 1e-14 * scale * scale * scale:
        return False
    inv = 1.0 / det
    hinv[0, 0] = c00 * inv
    hinv[0, 1] = hinv[1, 0] = c01 * inv
    hinv[0, 2] = hinv[2, 0] = c02 * inv
    hinv[1, 1] = (h00 * h22 - h02 * h02) * inv
    hinv[1, 2] = hinv[2, 1] = (h01 * h02 - h00 * h12) * inv
    hinv[2, 2] = (h00 * h11 - h01 * h01) * inv
    return True


@njit
def count_pairs(starts, obs_kf, free):
    """How many (free keyframe, free keyframe) pairs, the diagonal included, the points join, and most of one point."""
    total = 0
    most = 0
    for pt in range(starts.shape[0] - 1):
        n = 0
        for o in range(starts[pt], starts[pt + 1]):
            if free[obs_kf[o]] >= 0:
                n += 1
        total += n * (n + 1) // 2
        most = max(most, n)
    return total, most


@njit
def list_pairs(starts, obs_kf, free, keys):
    """Fills keys with row * F + column (row >= column) of every pair in the order in which `reduce` visits them."""
    n_free = 0
    for k in range(free.shape[0]):
        n_free = max(n_free, free[k] + 1)
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
def reduce(starts, obs_kf, free, rot, lin, damping, most, blocks, slots, b):
    """Subtracts W H_point^-1 W^T and W H_point^-1 b_point of every point from the reduced system.

    Args:
        starts: (P + 1,) first observation of every point. free: (K,) row of a keyframe, -1 when it is fixed.
        most: the largest number of free keyframes of one point.
        blocks: (B, 6, 6) lower blocks of the reduced matrix, changed. slots: block of every pair in `list_pairs` order.
        b: (F, 6), changed.
    """
    a_all, _, p_all, _ = lin
    hinv = np.zeros((3, 3))
    bp = np.zeros(3)
    ar = np.zeros((3, 3))
    w_all = np.zeros((max(most, 1), 6, 3))
    row = np.zeros(max(most, 1), np.int64)
    y = np.zeros((6, 3))
    i = 0
    for pt in range(starts.shape[0] - 1):
        first, last = starts[pt], starts[pt + 1]
        n = 0
        for o in range(first, last):
            c = free[obs_kf[o]]
            if c >= 0:
                _cross_blocks(a_all[o], p_all[o], rot[obs_kf[o]], ar, w_all[n])
                row[n] = c
                n += 1
        if not _point_block(first, last, obs_kf, rot, lin, damping, hinv, bp):
            i += n * (n + 1) // 2
            continue
        for m in range(n):
            w = w_all[m]
            bc = b[row[m]]
            for k in range(6):
                y[k, 0] = w[k, 0] * hinv[0, 0] + w[k, 1] * hinv[1, 0] + w[k, 2] * hinv[2, 0]
                y[k, 1] = w[k, 0] * hinv[0, 1] + w[k, 1] * hinv[1, 1] + w[k, 2] * hinv[2, 1]
                y[k, 2] = w[k, 0] * hinv[0, 2] + w[k, 1] * hinv[1, 2] + w[k, 2] * hinv[2, 2]
                bc[k] -= y[k, 0] * bp[0] + y[k, 1] * bp[1] + y[k, 2] * bp[2]
            for q in range(m + 1):
                s, x = blocks[slots[i]], w_all[q]
                i += 1
                if row[m] >= row[q]:
                    for k in range(6):
                        for j in range(6):
                            s[k, j] -= y[k, 0] * x[j, 0] + y[k, 1] * x[j, 1] + y[k, 2] * x[j, 2]
                else:
                    for k in range(6):
                        for j in range(6):
                            s[j, k] -= y[k, 0] * x[j, 0] + y[k, 1] * x[j, 1] + y[k, 2] * x[j, 2]
                if row[m] == row[q] and m != q:  # one keyframe sees the point twice: both orders fall on its diagonal
                    for k in range(6):
                        for j in range(6):
                            s[j, k] -= y[k, 0] * x[j, 0] + y[k, 1] * x[j, 1] + y[k, 2] * x[j, 2]


@njit
def point_steps(starts, obs_kf, free, rot, lin, damping, step, points, out):
    """Back substitution: out = points + H_point^-1 (b_point - W^T step) with step (F, 6)."""
    a_all, _, p_all, _ = lin
    hinv = np.zeros((3, 3))
    b = np.zeros(3)
    v = np.zeros(3)
    for pt in range(starts.shape[0] - 1):
        first, last = starts[pt], starts[pt + 1]
        out[pt, 0], out[pt, 1], out[pt, 2] = points[pt, 0], points[pt, 1], points[pt, 2]
        if not _point_block(first, last, obs_kf, rot, lin, damping, hinv, b):
            continue
        for o in range(first, last):
            c = free[obs_kf[o]]
            if c < 0:
                continue
            x, p, a, r = step[c], p_all[o], a_all[o], rot[obs_kf[o]]
            v[0] = p[1] * x[5] - p[2] * x[4] - x[0]
            v[1] = p[2] * x[3] - p[0] * x[5] - x[1]
            v[2] = p[0] * x[4] - p[1] * x[3] - x[2]
            u0 = a[0] * v[0] + a[1] * v[1] + a[2] * v[2]
            u1 = a[1] * v[0] + a[3] * v[1] + a[4] * v[2]
            u2 = a[2] * v[0] + a[4] * v[1] + a[5] * v[2]
            for k in range(3):
                b[k] -= r[k, 0] * u0 + r[k, 1] * u1 + r[k, 2] * u2
        for k in range(3):
            out[pt, k] += hinv[k, 0] * b[0] + hinv[k, 1] * b[1] + hinv[k, 2] * b[2]
