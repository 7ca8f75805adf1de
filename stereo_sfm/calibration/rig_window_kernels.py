"""Compiled inner loop of `calibration.rig_window`: normal equations of one window with its points eliminated.

Unknown are eight terms of the rig (rotation of the right camera, direction of the baseline, focal ratio, decentering of
the right lens), what both lenses share, six numbers of every moment after the first, and of each point its bearing (2)
and inverse distance in the first left camera. One row touches what is shared, its own moment and its point, so the work
a point is small; the Schur complement over the points is Triggs et al., Bundle adjustment: a modern synthesis (2000),
section 6.1.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.kernels import PINHOLE, RADTAN, inlined, inner, njit, project_one
from stereo_sfm.types import RIG_TERMS


@njit
def _rows(cam, params, p, dp, uv, j_point, residual, at):
    """Residual of one image of one point, NaN where it cannot be seen, and its derivative; `dp` (3, 3) is p's."""
    u, v, j00, j01, j02, j10, j11, j12 = project_one(cam, params, p[0], p[1], p[2])
    residual[at], residual[at + 1] = uv[0] - u, uv[1] - v
    for k in range(3):
        j_point[at, k] = j00 * dp[0, k] + j01 * dp[1, k] + j02 * dp[2, k]
        j_point[at + 1, k] = j10 * dp[0, k] + j11 * dp[1, k] + j12 * dp[2, k]
    return u, v, j00, j01, j02, j10, j11, j12


@inner
def _pose_row(j0, j1, j2, p, rho, out):
    """A row (j) of the projection by a left perturbation (rho, phi) of the moment's pose, p scaled by `rho`."""
    out[0], out[1], out[2] = rho * j0, rho * j1, rho * j2
    out[3] = j2 * p[1] - j1 * p[2]
    out[4] = j0 * p[2] - j2 * p[0]
    out[5] = j1 * p[0] - j0 * p[1]


@inner
def _lens_rows(shape, lens, j_rig, residual, at):
    """What the lens's terms do to one image's rows."""
    for i in range(2):
        for k in range(lens.shape[0]):
            j_rig[at + i, RIG_TERMS + k] = shape[i, k]
            residual[at + i] -= shape[i, k] * lens[k]


@njit
def accumulate(
    uv_left, uv_right, bearing, tangent, rho, rot, pos, shapes, lens, cams, right_r, baseline, by_direction, sigma,
    hard, h, g, gain, gradient, size, rows,
):  # fmt: skip
    """Fills the reduced normal equations and what gives the points' own steps.

    Args:
        uv_left, uv_right: (F, N, 2) px, NaN where not seen. bearing: (N, 3). tangent: (N, 3, 2). rho: (N,).
        rot, pos: (F, 3, 3), (F, 3) of frame_T_first.
        shapes: (2, F, N, 2, L) displacement of the pixels of each image by each of the lens's terms. lens: (L,) those.
        cams: models and parameters of both cameras.
        right_r: (3, 3) rotation of right_T_left. baseline: (3,) right camera in the left one.
        by_direction: (3, 2) derivative of rho-scaled right coordinates by the baseline's direction.
        sigma: px. hard: drop what is beyond six sigmas.
        h: (R, R), g: (R,), R = 8 + L + 6 (F - 1), overwritten. gain: (N, 3, R), gradient: (N, 3), overwritten.
        size: (N,) sum of squared residuals. rows: (N,) how many.
    """
    frames, count = uv_left.shape[0], uv_left.shape[1]
    model_l, params_l, model_r, params_r = cams
    shared = RIG_TERMS + lens.shape[0]
    r_size = shared + 6 * (frames - 1)
    h[:] = 0.0
    g[:] = 0.0
    residual = np.zeros(4)
    j_point = np.zeros((4, 3))
    j_rig = np.zeros((4, shared))
    j_pose = np.zeros((4, 6))
    p, q = np.zeros(3), np.zeros(3)
    dp, dq = np.zeros((3, 3)), np.zeros((3, 3))
    row = np.zeros(3)
    hpp = np.zeros((3, 3))
    for n in range(count):
        hpp[:] = 0.0
        gp = gradient[n]
        hpr = gain[n]
        gp[:] = 0.0
        hpr[:] = 0.0
        size[n] = 0.0
        rows[n] = 0
        for f in range(frames):
            if not math.isfinite(uv_left[f, n, 0]):
                continue
            for i in range(3):
                p[i] = rho[n] * pos[f, i]
                for k in range(3):
                    p[i] += rot[f, i, k] * bearing[n, k]
                dp[i, 2] = pos[f, i]
                for c in range(2):
                    dp[i, c] = 0.0
                    for k in range(3):
                        dp[i, c] += rot[f, i, k] * tangent[n, k, c]
            out = _rows(model_l, params_l, p, dp, uv_left[f, n], j_point, residual, 0)
            if not math.isfinite(residual[0]):
                continue
            _pose_row(out[2], out[3], out[4], p, rho[n], j_pose[0])
            _pose_row(out[5], out[6], out[7], p, rho[n], j_pose[1])
            _lens_rows(shapes[0, f, n], lens, j_rig, residual, 0)
            used = 2
            if math.isfinite(uv_right[f, n, 0]):
                for i in range(3):
                    q[i] = 0.0
                    for k in range(3):
                        q[i] += right_r[i, k] * (p[k] - rho[n] * baseline[k])
                    for c in range(3):
                        dq[i, c] = 0.0
                        for k in range(3):
                            dq[i, c] += right_r[i, k] * (dp[k, c] - (baseline[k] if c == 2 else 0.0))
                out = _rows(model_r, params_r, q, dq, uv_right[f, n], j_point, residual, 2)
                if math.isfinite(residual[2]):
                    used = 4
                    _lens_rows(shapes[1, f, n], lens, j_rig, residual, 2)
                    for k in range(2):
                        j0, j1, j2 = out[2 + 3 * k], out[3 + 3 * k], out[4 + 3 * k]
                        # by the rotation of the right camera: q x omega
                        j_rig[2 + k, 0] = j1 * q[2] - j2 * q[1]
                        j_rig[2 + k, 1] = j2 * q[0] - j0 * q[2]
                        j_rig[2 + k, 2] = j0 * q[1] - j1 * q[0]
                        for c in range(2):
                            j_rig[2 + k, 3 + c] = rho[n] * (
                                j0 * by_direction[0, c] + j1 * by_direction[1, c] + j2 * by_direction[2, c]
                            )
                        j_rig[2 + k, 5] = out[k] - params_r[2 + k]
                    if model_l == PINHOLE and model_r <= RADTAN:  # a distorted lens was calibrated with its decentering
                        a, b = q[0] / q[2], q[1] / q[2]
                        j_rig[2, 6], j_rig[3, 6] = -params_r[0] * b * b, params_r[1] * a * b
                        j_rig[2, 7], j_rig[3, 7] = -params_r[0] * a * b, params_r[1] * a * a
                    for k in range(2):
                        j0, j1, j2 = out[2 + 3 * k], out[3 + 3 * k], out[4 + 3 * k]
                        for i in range(3):
                            row[i] = j0 * right_r[0, i] + j1 * right_r[1, i] + j2 * right_r[2, i]
                        _pose_row(row[0], row[1], row[2], p, rho[n], j_pose[2 + k])
            worst = 0.0
            for i in range(used):
                worst = max(worst, abs(residual[i]))
                size[n] += residual[i] * residual[i]
            rows[n] += used
            ratio = worst / sigma  # Cauchy's scale: tracks' errors have long tails, and lean to one side there
            w = 0.0 if hard and ratio > 6.0 else 1.0 / ((1.0 + ratio * ratio) * sigma * sigma)
            if w == 0.0:
                continue
            o = shared + 6 * (f - 1)
            if used == 2:
                residual[2:], j_point[2:], j_rig[2:], j_pose[2:] = 0.0, 0.0, 0.0, 0.0
            for a in range(3):
                w0, w1, w2, w3 = w * j_point[0, a], w * j_point[1, a], w * j_point[2, a], w * j_point[3, a]
                gp[a] = gp[a] - w0 * residual[0] - w1 * residual[1] - w2 * residual[2] - w3 * residual[3]
                for b in range(3):
                    hpp[a, b] = _plus(hpp[a, b], w0, w1, w2, w3, j_point, b)
                for b in range(shared):
                    hpr[a, b] = _plus(hpr[a, b], w0, w1, w2, w3, j_rig, b)
                if f > 0:
                    for b in range(6):
                        hpr[a, o + b] = _plus(hpr[a, o + b], w0, w1, w2, w3, j_pose, b)
            for a in range(shared):
                w0, w1, w2, w3 = w * j_rig[0, a], w * j_rig[1, a], w * j_rig[2, a], w * j_rig[3, a]
                g[a] = g[a] - w0 * residual[0] - w1 * residual[1] - w2 * residual[2] - w3 * residual[3]
                for b in range(a, shared):
                    h[a, b] = _plus(h[a, b], w0, w1, w2, w3, j_rig, b)
                if f > 0:
                    for b in range(6):
                        h[a, o + b] = _plus(h[a, o + b], w0, w1, w2, w3, j_pose, b)
            if f > 0:
                for a in range(6):
                    w0, w1, w2, w3 = w * j_pose[0, a], w * j_pose[1, a], w * j_pose[2, a], w * j_pose[3, a]
                    g[o + a] = g[o + a] - w0 * residual[0] - w1 * residual[1] - w2 * residual[2] - w3 * residual[3]
                    for b in range(a, 6):
                        h[o + a, o + b] = _plus(h[o + a, o + b], w0, w1, w2, w3, j_pose, b)
        _eliminate(hpp, gp, hpr, h, g, r_size)
    for a in range(r_size):
        for b in range(a):
            h[a, b] = h[b, a]


@inlined
def _plus(x, w0, w1, w2, w3, j, b):
    """x and the weighted column b of four rows."""
    return x + w0 * j[0, b] + w1 * j[1, b] + w2 * j[2, b] + w3 * j[3, b]


@inner
def _eliminate(hpp, gp, hpr, h, g, r_size):
    """Schur complement of one point, upper triangle; gp and hpr become hpp^-1 gp and hpp^-1 hpr.

    A point nothing is known of stays.
    """
    a, b, c = hpp[0, 0], hpp[0, 1], hpp[0, 2]
    d, e, f = hpp[1, 1], hpp[1, 2], hpp[2, 2]
    damping = 1e-9 * (a + d + f)
    a, d, f = a + damping, d + damping, f + damping
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * c00 + b * c01 + c * c02
    if not det > 0.0:
        gp[:] = 0.0
        hpr[:] = 0.0
        return
    c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
    x = np.empty((3, r_size))
    for j in range(r_size):
        y0, y1, y2 = hpr[0, j], hpr[1, j], hpr[2, j]
        x[0, j] = (c00 * y0 + c01 * y1 + c02 * y2) / det
        x[1, j] = (c01 * y0 + c11 * y1 + c12 * y2) / det
        x[2, j] = (c02 * y0 + c12 * y1 + c22 * y2) / det
        g[j] -= x[0, j] * gp[0] + x[1, j] * gp[1] + x[2, j] * gp[2]
    for i in range(r_size):
        y0, y1, y2 = hpr[0, i], hpr[1, i], hpr[2, i]
        for j in range(i, r_size):
            h[i, j] -= x[0, j] * y0 + x[1, j] * y1 + x[2, j] * y2
    hpr[:] = x
    g0, g1, g2 = gp[0], gp[1], gp[2]
    gp[0] = (c00 * g0 + c01 * g1 + c02 * g2) / det
    gp[1] = (c01 * g0 + c11 * g1 + c12 * g2) / det
    gp[2] = (c02 * g0 + c12 * g1 + c22 * g2) / det
