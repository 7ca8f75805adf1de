"""Motion-only optimisation: the pose of one stereo frame from points of the local map, with covariance.

A point lies on the ray of its first observation, P = origin + direction / rho, with a variance of rho. The pose is
solved by iteratively re-weighted Gauss-Newton on the pixels of both images, together with every rho: rho is eliminated
first (the four residuals of a point share one unknown: a rank-one update, Sherman-Morrison), then updated by back
substitution. So a point with an uncertain distance contributes to the rotation at full weight, and the derivatives by
the pose are taken at consistent pose and distances. At the prior distances they would contain its squared error, and
every step would be too short by the variance of rho over rho squared (errors in variables; Fuller, Measurement Error
Models, 1987, section 1.1). Robust weights are Cauchy, narrowed in steps (graduated non-convexity, Yang et al., RA-L 5,
2020, with a Cauchy kernel).

With a rolling shutter, each point is observed from the pose at the time of its row: pose @ exp(seconds * velocity). The
velocity is solved with the pose (Ait-Aider et al., Simultaneous object pose and velocity computation using a single
view from a rolling shutter camera, ECCV 2006), with the mean velocity since the last frame as its prior.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereo_sfm.geometry.kernels import inlined, inner, njit, project_one
from stereo_sfm.geometry.se3_kernels import compose_into, exp_into, rectify_rotation
from stereo_sfm.geometry.small_matrix import invert_symmetric, solve_symmetric
from stereo_sfm.types import F64

MAX_SIGMAS = 4.0  # change of an inverse distance while a pose is solved
MIN_RHO = 1e-4  # 1/m


class SeenPoints(NamedTuple):
    """N points on the rays of their first observations, and where one frame sees them."""

    origin: F64  # (N, 3) metres, odometry frame
    direction: F64  # (N, 3) unit, odometry frame
    rho: F64  # (N,) 1/m
    variance: F64  # (N,) of rho
    uv_left: F64  # (N, 2) px
    uv_right: F64  # (N, 2) px, NaN where unseen
    row_s: F64  # (N,) seconds from the pose's time to that of the point's row; (0,) for a global shutter


@inlined
def point_residuals(pose, px, py, pz, dx, dy, dz, uv_l, uv_r, cameras, res, jac, ray):
    """Residuals of one point in both images.

    Args:
        pose: (4, 4) odom_T_cam. px..pz: the point and dx..dz: its derivative by rho, odometry frame.
        uv_l, uv_r: (2,) px. cameras: StereoCameras.
        res (4,), jac (4, 6), ray (4,): filled in; derivatives by odom_T_cam @ exp(xi) and by rho.

    Returns:
        0 if the left pixel cannot be predicted, 2 with the left image only, 4 with both, 3 with a depth camera.
    """
    qx, qy, qz = px - pose[0, 3], py - pose[1, 3], pz - pose[2, 3]
    x = pose[0, 0] * qx + pose[1, 0] * qy + pose[2, 0] * qz
    y = pose[0, 1] * qx + pose[1, 1] * qy + pose[2, 1] * qz
    z = pose[0, 2] * qx + pose[1, 2] * qy + pose[2, 2] * qz
    gx = pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz
    gy = pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz
    gz = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
    a = project_one(cameras.model_l, cameras.params_l, x, y, z)
    if math.isnan(a[0]):
        return 0
    rows = 2
    res[0], res[1] = a[0] - uv_l[0], a[1] - uv_l[1]
    for i in range(2):
        ju, jv, jw = a[2 + 3 * i], a[3 + 3 * i], a[4 + 3 * i]
        ray[i] = ju * gx + jv * gy + jw * gz
        jac[i, 0], jac[i, 1], jac[i, 2] = -ju, -jv, -jw
        jac[i, 3], jac[i, 4], jac[i, 5] = jv * z - jw * y, jw * x - ju * z, ju * y - jv * x
    if not math.isnan(uv_r[0]):
        t = cameras.right_T_left
        rx = t[0, 0] * x + t[0, 1] * y + t[0, 2] * z + t[0, 3]
        ry = t[1, 0] * x + t[1, 1] * y + t[1, 2] * z + t[1, 3]
        rz = t[2, 0] * x + t[2, 1] * y + t[2, 2] * z + t[2, 3]
        b = project_one(cameras.model_r, cameras.params_r, rx, ry, rz)
        if not math.isnan(b[0]):
            rows = 4
            res[2], res[3] = b[0] - uv_r[0], b[1] - uv_r[1]
            for i in range(2):
                j0, j1, j2 = b[2 + 3 * i], b[3 + 3 * i], b[4 + 3 * i]
                ju = j0 * t[0, 0] + j1 * t[1, 0] + j2 * t[2, 0]
                jv = j0 * t[0, 1] + j1 * t[1, 1] + j2 * t[2, 1]
                jw = j0 * t[0, 2] + j1 * t[1, 2] + j2 * t[2, 2]
                ray[2 + i] = ju * gx + jv * gy + jw * gz
                jac[2 + i, 0], jac[2 + i, 1], jac[2 + i, 2] = -ju, -jv, -jw
                jac[2 + i, 3], jac[2 + i, 4], jac[2 + i, 5] = jv * z - jw * y, jw * x - ju * z, ju * y - jv * x
            if cameras.depth:
                rows = 3
                res[2] -= res[0]
                ray[2] -= ray[0]
                for i in range(6):
                    jac[2, i] -= jac[0, i]
    return rows


@njit
def normal_equations(pose, velocity, points, rho, cameras, sigma, scale, normal, rhs, error, elimination):
    """Sums over all points, each with its distance eliminated; a robust weight by a Cauchy kernel of `scale` sigmas.

    Args:
        rho: (N,) inverse distances at which the points are linearised; those of `points` are their priors.
        normal (n, n), rhs (n,), error (N,): overwritten; see `optimise_pose`. n is 6, with a rolling shutter 12.
        elimination: (N, 7) overwritten: minus the step of rho is its last column and the others times the pose's step.

    Returns:
        The sum of the weights.
    """
    origin, direction, prior, variance, uv_l, uv_r, row_s = points
    res, jac, ray, jr = np.zeros(4), np.zeros((4, 6)), np.zeros(4), np.zeros(6)
    gradient, block = np.zeros(6), np.zeros((6, 6))  # of one point
    rolling = len(row_s) > 0
    row, step = pose.copy(), np.zeros((4, 4))  # the pose at the point's row
    inv_s2 = 1.0 / (sigma * sigma)
    used = 0.0
    normal[:] = 0.0
    rhs[:] = 0.0
    for k in range(len(rho)):
        ir = 1.0 / rho[k]
        g = -ir * ir
        if rolling:
            exp_into(velocity, row_s[k], step)
            compose_into(pose, step, row)
        rows = point_residuals(
            row, origin[k, 0] + direction[k, 0] * ir, origin[k, 1] + direction[k, 1] * ir,
            origin[k, 2] + direction[k, 2] * ir, direction[k, 0] * g, direction[k, 1] * g, direction[k, 2] * g,
            uv_l[k], uv_r[k], cameras, res, jac, ray,
        )  # fmt: skip
        if rows == 0:
            error[k] = np.inf
            elimination[k] = 0.0
            continue
        rr, gr, gg = 0.0, 0.0, 0.0
        for i in range(rows):
            rr += res[i] * res[i]
            gr += ray[i] * res[i]
            gg += ray[i] * ray[i]
        c = variance[k] / (sigma * sigma + variance[k] * gg)
        off, trust = rho[k] - prior[k], sigma * sigma / variance[k]
        gr += trust * off
        chi2 = max(rr + trust * off * off - c * gr * gr, 0.0) * inv_s2
        elimination[k, 6] = c * gr
        error[k] = math.sqrt(chi2 / rows)
        w = 1.0 / (1.0 + chi2 / (rows * scale * scale))
        wi = w * inv_s2
        used += w
        for m in range(rows, 4):
            res[m] = ray[m] = 0.0
            jac[m] = 0.0
        r0, r1, r2, r3 = res[0], res[1], res[2], res[3]
        y0, y1, y2, y3 = ray[0], ray[1], ray[2], ray[3]
        for i in range(6):
            jr[i] = jac[0, i] * y0 + jac[1, i] * y1 + jac[2, i] * y2 + jac[3, i] * y3
            elimination[k, i] = c * jr[i]
        for i in range(6):
            a0, a1, a2, a3, ci = jac[0, i], jac[1, i], jac[2, i], jac[3, i], c * jr[i]
            gradient[i] = wi * (a0 * r0 + a1 * r1 + a2 * r2 + a3 * r3 - ci * gr)
            rhs[i] += gradient[i]
            for j in range(i, 6):
                s = a0 * jac[0, j] + a1 * jac[1, j] + a2 * jac[2, j] + a3 * jac[3, j]
                block[i, j] = wi * (s - ci * jr[j])
                normal[i, j] += block[i, j]
        if rolling:  # a row's pose follows the velocity by the row's seconds
            for i in range(6):
                rhs[6 + i] += row_s[k] * gradient[i]
                for j in range(i, 6):
                    normal[i, 6 + j] += row_s[k] * block[i, j]
                    normal[6 + i, 6 + j] += row_s[k] * row_s[k] * block[i, j]
    for i in range(6):
        for j in range(i):
            normal[i, j] = normal[j, i]
            if rolling:
                normal[i, 6 + j] = normal[j, 6 + i]
                normal[6 + i, 6 + j] = normal[6 + j, 6 + i]
    if rolling:
        for i in range(6):
            for j in range(6):
                normal[6 + i, j] = normal[j, 6 + i]
    return used


@inner
def _add_prior(pose, expected, sigmas, normal, rhs):
    """Add the prior of the pose (4, 4), to first order in its difference from it, to the normal equations."""
    difference = np.zeros(6)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for m in range(3):
            difference[i] += expected[m, i] * (pose[m, 3] - expected[m, 3])
            difference[3 + i] += 0.5 * (expected[m, k] * pose[m, j] - expected[m, j] * pose[m, k])
    for i in range(6):
        information = 1.0 / (sigmas[i] * sigmas[i])
        normal[i, i] += information
        rhs[i] += information * difference[i]


@inner
def _move_distances(rho, prior, variance, elimination, xi, row_s):
    """Back substitution: update every inverse distance for a step of the pose (and velocity), within limits."""
    for k in range(len(rho)):
        step = elimination[k, 6]
        for i in range(6):
            step += elimination[k, i] * (xi[i] + row_s[k] * xi[6 + i] if len(row_s) > 0 else xi[i])
        reach = MAX_SIGMAS * math.sqrt(variance[k])
        rho[k] = max(min(max(rho[k] - step, prior[k] - reach), prior[k] + reach), MIN_RHO)


@njit
def optimise_pose(
    pose, moved, seconds, velocity_sigma, points, cameras, sigma, scales, expected, expected_sigmas
):  # fmt: skip
    """Pose of a frame.

    Args:
        pose: (4, 4) odom_T_cam to start from.
        moved: (6,) tangent from the last frame's pose to that one, `seconds` before. velocity_sigma: (6,) standard
            deviation of the velocity at this frame from the mean since the last. These are for rolling shutters only.
        points: SeenPoints. cameras: StereoCameras.
        sigma: px, noise of one coordinate. scales: (S,) Cauchy scales in sigmas, one Gauss-Newton step each.
        expected: (4, 4) prior of the pose. expected_sigmas: (6,) its standard deviations, metres and radians along and
            about the camera's axes; infinite: there is none.

    Returns:
        pose (4, 4), velocity (6,) a second, covariance (6, 6) of pose @ exp(xi), error (N,) root of the whitened
        squared residual over the number of rows (1: as expected; inf if not visible).
    """
    rate = 1.0 / seconds if seconds > 0 else 0.0
    prior, variance, row_s = points.rho, points.variance, points.row_s
    pose, moved, velocity = pose.copy(), moved.copy(), moved * rate
    error = np.full(len(prior), np.inf)
    n = 12 if len(row_s) > 0 else 6
    normal, factor = np.zeros((n, n)), np.zeros((n, n))
    rhs, xi, move = np.zeros(n), np.zeros(n), np.zeros((4, 4))
    rho, elimination = prior.copy(), np.zeros((len(prior), 7))
    for step in range(len(scales) + 1):  # the last pass is for errors and covariance
        scale = scales[min(step, len(scales) - 1)]
        used = normal_equations(pose, velocity, points, rho, cameras, sigma, scale, normal, rhs, error, elimination)
        if math.isfinite(expected_sigmas[0]):
            _add_prior(pose, expected, expected_sigmas, normal, rhs)
        for i in range(n - 6):  # prior of the velocity: the mean motion since the last frame
            information = 1.0 / (velocity_sigma[i] * velocity_sigma[i])
            difference = velocity[i] - moved[i] * rate
            normal[i, i] += information * rate * rate
            normal[i, 6 + i] -= information * rate
            normal[6 + i, i] -= information * rate
            normal[6 + i, 6 + i] += information
            rhs[i] -= information * rate * difference
            rhs[6 + i] += information * difference
        if step == len(scales) or used < 3:
            break
        for i in range(n):
            normal[i, i] += 1e-6 + 1e-9 * normal[i, i]
            rhs[i] = -rhs[i]
        if not solve_symmetric(normal, rhs, xi, factor):
            break
        exp_into(xi, 1.0, move)
        compose_into(pose.copy(), move, pose)
        _move_distances(rho, prior, variance, elimination, xi, row_s)
        for i in range(n - 6):
            moved[i] += xi[i]
            velocity[i] += xi[6 + i]
    rectify_rotation(pose)
    for i in range(n):
        normal[i, i] += 1e-9
    inverse = np.full((n, n), np.inf)
    invert_symmetric(normal, inverse, factor)
    return pose, velocity, inverse[:6, :6].copy(), error


@inner
def _row_residuals(k, pose, velocity, points, cameras, row, step, res, jac, ray):
    """`point_residuals` of point k, with the camera where it was when the point's row was exposed.

    `normal_equations` has this written out: it runs several times a frame, and the call would cost it half its time.

    Args:
        pose, velocity, points, cameras: as of `optimise_pose`.
        row: (4, 4) a copy of the pose; overwritten with the pose at the row. step: (4, 4) overwritten.
        res, jac, ray: overwritten.

    Returns:
        The number of rows.
    """
    origin, direction, ir = points.origin, points.direction, 1.0 / points.rho[k]
    g = -ir * ir
    if len(points.row_s) > 0:
        exp_into(velocity, points.row_s[k], step)
        compose_into(pose, step, row)
    return point_residuals(
        row, origin[k, 0] + direction[k, 0] * ir, origin[k, 1] + direction[k, 1] * ir,
        origin[k, 2] + direction[k, 2] * ir, direction[k, 0] * g, direction[k, 1] * g, direction[k, 2] * g,
        points.uv_left[k], points.uv_right[k], cameras, res, jac, ray,
    )  # fmt: skip


@njit
def errors_at(pose, velocity, points, cameras, sigma):
    """(N,) whitened errors of points at a pose, as from `optimise_pose`, with its arguments."""
    rho, variance = points.rho, points.variance
    error = np.full(len(rho), np.inf)
    res, jac, ray = np.zeros(4), np.zeros((4, 6)), np.zeros(4)
    row, step = pose.copy(), np.zeros((4, 4))
    for k in range(len(rho)):
        rows = _row_residuals(k, pose, velocity, points, cameras, row, step, res, jac, ray)
        if rows == 0:
            continue
        rr, gr, gg = 0.0, 0.0, 0.0
        for i in range(rows):
            rr += res[i] * res[i]
            gr += ray[i] * res[i]
            gg += ray[i] * ray[i]
        c = variance[k] / (sigma * sigma + variance[k] * gg)
        error[k] = math.sqrt(max(rr - c * gr * gr, 0.0) / rows) / sigma
    return error


@njit
def influence(pose, velocity, covariance, points, cameras, sigma, scale):
    """What points say about a pose beside its covariance (6, 6), whether it was solved from them or from others.

    A point on which much of a pose rests has a small error there whatever it shows. At a pose by the others it has not
    (Cook & Weisberg, Residuals and Influence in Regression, 1982, section 2.2, leverage and deleted residuals).
    Arguments as of `optimise_pose`, the last Cauchy scale.

    Returns:
        (N,) degrees of freedom of the pose that rest on each point if it was solved from them: of all points 6.
        (N,) errors, whitened by the noise of the point and of the pose if it was solved from others; inf for points
        that are not visible.
    """
    rho, variance = points.rho, points.variance
    res, jac, ray, seen = np.zeros(4), np.zeros((4, 6)), np.zeros(4), np.zeros((4, 4))
    row, step = pose.copy(), np.zeros((4, 4))
    leverages, errors = np.zeros(len(rho)), np.full(len(rho), np.inf)
    spread, left, factor, white = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4)), np.zeros(4)
    for k in range(len(rho)):
        rows = _row_residuals(k, pose, velocity, points, cameras, row, step, res, jac, ray)
        if rows == 0:
            continue
        for i in range(rows, 4):
            res[i], ray[i], jac[i] = 0.0, 0.0, 0.0
        for a in range(4):
            for b in range(4):
                seen[a, b] = 0.0  # of the pose's covariance in rows a and b
                for i in range(6):
                    for j in range(6):
                        seen[a, b] += jac[a, i] * covariance[i, j] * jac[b, j]
                spread[a, b] = variance[k] * ray[a] * ray[b] + (sigma * sigma if a == b else 0.0)
        invert_symmetric(spread, left, factor)
        chi2 = 0.0
        for a in range(4):
            for b in range(4):
                chi2 += left[a, b] * res[a] * res[b]
                leverages[k] += left[a, b] * seen[a, b]
                spread[a, b] += seen[a, b]
        leverages[k] /= 1.0 + chi2 / (rows * scale * scale)
        if solve_symmetric(spread, res, white, factor):
            total = 0.0
            for a in range(4):
                total += res[a] * white[a]
            errors[k] = math.sqrt(max(total, 0.0) / rows)
    return leverages, errors


@inner
def _by_common_rho(variance, error, elimination, scale):
    """(6,) change of the gradient that `normal_equations` gave if all inverse distances were larger by 1/m.

    An error of the rig does that. variance (N,) of them; error (N,), elimination (N, 7) and scale as they were there.
    """
    change = np.zeros(6)
    for k in range(len(variance)):
        for i in range(6):
            change[i] += elimination[k, i] / (variance[k] * (1.0 + (error[k] / scale) ** 2))
    return change


@njit
def by_common_rho(pose, velocity, points, cameras, sigma, scale):
    """`_by_common_rho` at a pose; arguments as of `optimise_pose`, the last Cauchy scale."""
    n = 12 if len(points.row_s) > 0 else 6
    normal, rhs, error, elimination = (
        np.zeros((n, n)),
        np.zeros(n),
        np.empty(len(points.rho)),
        np.empty((len(points.rho), 7)),
    )
    normal_equations(pose, velocity, points, points.rho, cameras, sigma, scale, normal, rhs, error, elimination)
    return _by_common_rho(points.variance, error, elimination, scale)


@njit
def shift_chi2(pose, velocity, covariance, points, cameras, sigma, scale, others, drift, rho_sigma):
    """How far from a pose, with covariance (6, 6), the others alone would have it than some `points`, in squared
    sigmas; inf if it rests on these.

    To first order: at a pose by all, the gradients of these and of the others cancel each other. Arguments as of
    `optimise_pose`, the last Cauchy scale; besides noise, all inverse distances err by one `rho_sigma`, 1/m, and the
    pose by the others has the variances `drift` (6,).
    """
    n = 12 if len(points.row_s) > 0 else 6
    normal, rhs, inverse, factor = np.zeros((n, n)), np.zeros(n), np.full((6, 6), np.inf), np.zeros((6, 6))
    x = np.zeros(6)
    error, elimination = np.empty(len(points.rho)), np.empty((len(points.rho), 7))
    normal_equations(pose, velocity, points, points.rho, cameras, sigma, scale, normal, rhs, error, elimination)
    if not invert_symmetric(covariance, inverse, factor):
        return math.inf
    if n == 12:  # the velocity is unknown
        y, own = np.zeros(6), np.ascontiguousarray(normal[6:, 6:]) + 1e-9 * np.eye(6)
        for i in range(6):
            if not solve_symmetric(own, normal[6:, i].copy(), y, factor):
                return math.inf
            rhs[i] -= (y * rhs[6:]).sum()
            for j in range(6):
                normal[j, i] -= (normal[j, 6:] * y).sum()
    shift = _by_common_rho(points.variance, error, elimination, scale)
    moved = shift + by_common_rho(pose, velocity, others, cameras, sigma, scale)
    for i in range(6):
        for j in range(6):
            inverse[i, j] -= normal[i, j]
            for k in range(6):
                shift[i] -= normal[i, k] * covariance[k, j] * moved[j]
    spread = inverse + rho_sigma * rho_sigma * np.outer(shift, shift)
    for i in range(6):
        for j in range(6):
            for k in range(6):
                spread[i, j] += inverse[i, k] * drift[k] * inverse[k, j]
    if not solve_symmetric(spread, rhs[:6].copy(), x, factor):
        return math.inf
    total = 0.0
    for i in range(6):
        total += rhs[i] * x[i]
    return total


@njit
def refine_depth(pose, velocity, points, inlier, cameras, sigma, floor):
    """Update rho and its variance (in place) by one frame's observations, pose and velocity given.

    `sigma` is larger than the pixel noise: successive errors of one patch are correlated, and the pose was fitted to
    the same pixels. `floor` is the smallest relative standard deviation.
    """
    rho, variance = points.rho, points.variance
    res, jac, ray = np.zeros(4), np.zeros((4, 6)), np.zeros(4)
    row, step = pose.copy(), np.zeros((4, 4))  # the pose at the point's row
    for k in range(len(rho)):
        if not inlier[k]:
            continue
        rows = _row_residuals(k, pose, velocity, points, cameras, row, step, res, jac, ray)
        if rows == 0:
            continue
        gr, gg = 0.0, 0.0
        for i in range(rows):
            gr += ray[i] * res[i]
            gg += ray[i] * ray[i]
        information = 1.0 / variance[k] + gg / (sigma * sigma)
        rho[k] = max(rho[k] - gr / (sigma * sigma) / information, MIN_RHO)
        variance[k] = max(1.0 / information, (floor * rho[k]) ** 2)
