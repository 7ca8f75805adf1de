"""A small bundle adjustment that asks points seen by both eyes, twice, how the calibration should change.

Unknown are the rotation of the right eye (3), the direction of the baseline (2), the focal length of both eyes and of
the right one alone (2), the time skew of the right eye (1), a smooth displacement of each image for the lens's own
imperfection (9 each, held small by a prior with a heavy tail), the motion of each window (6) and the points (bearing
and inverse depth, so that points at infinity and beyond stay what they are). Points are eliminated by the Schur
complement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.rig import Rig
from calib.tracks import Window
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.stereo import rectifying_rotations
from stereo_sfm.types import F64

ROTATION, DIRECTION, FOCAL, FOCAL_RIGHT, SKEW = slice(0, 3), slice(3, 5), 5, 6, 7
NUISANCE = 9
SHARED = 8 + 2 * NUISANCE
CORRELATED = 2.0  # the matches' errors are not independent: their deviation counts so many times
# One standard deviation of what may be wrong before any image is seen: radians, radians, ratios, seconds, px.
PRIOR = np.array([0.05] * 3 + [0.05] * 2 + [0.05, 0.05, 0.02] + ([0.3] * 2 + [0.15] * (NUISANCE - 2)) * 2)


@dataclass(frozen=True, eq=False)
class Correction:
    """What should be added to the calibration, with its covariance."""

    vector: F64  # (SHARED,)
    covariance: F64  # (SHARED, SHARED)
    loose_covariance: F64  # (SHARED, SHARED) as if the lens could be wrong by half a pixel in every term
    noise_px: float  # of one measured coordinate, robust
    points: int
    residual_px: float  # root mean square of the inliers after the fit

    @property
    def sigma(self) -> F64:
        """(SHARED,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    def apply(self, rig: Rig) -> Rig:
        """The rig with the corrected extrinsics and focal lengths."""
        return _moved(rig, self.vector)


@dataclass(eq=False)
class _Problem:
    """One window's measurements and its own unknowns."""

    left: F64  # (F, N, 2)
    right: F64
    velocity: F64  # zero where unknown
    bearing: F64  # (N, 3) unit, first left eye
    rho: F64  # (N,) inverse distance
    frame_T_first: F64  # (F, 4, 4)
    weight: F64  # (N, 4 F) of each row


def estimate(rig: Rig, windows: list[Window], iterations: int = 18) -> Correction:
    """Fit the correction of `rig` to the windows."""
    problems = [_problem(rig, w) for w in windows]
    vector, hessian = np.zeros(SHARED), np.eye(SHARED)
    sigma = 5.0
    for iteration in range(iterations):
        current = _moved(rig, vector)
        trust = _trust(vector)
        hessian, gradient = np.diag(trust), vector * trust
        steps: list[tuple[_Problem, F64, F64, F64, F64]] = []
        sizes: list[F64] = []
        for problem in problems:
            residual, by_point, by_rest = _linearised(current, problem, vector)
            sizes.append(_point_noise(residual))
            problem.weight = _weights(residual, sigma, hard=iteration >= 9)
            h, g, step = _reduced(problem, residual, by_point, by_rest, sigma)
            hessian, gradient = hessian + h, gradient + g
            steps.append((problem, *step))
        delta = np.asarray(-np.linalg.solve(hessian, gradient), float)
        for problem, pose_gain, pose_gradient, point_gain, point_gradient in steps:
            _apply(problem, delta, pose_gain, pose_gradient, point_gain, point_gradient)
        vector = vector + delta
        sigma = float(np.clip(np.median(np.concatenate(sizes)), 0.1, 30.0))
    covariance = np.asarray(np.linalg.inv(hessian), float)
    loose = hessian.copy()
    lens = np.arange(8, SHARED)
    loose[lens, lens] += 1 / np.maximum(0.5, np.abs(vector[8:])) ** 2 - _trust(vector)[8:]
    loose_covariance = np.asarray(np.linalg.inv(loose), float)
    kept = np.concatenate([(p.weight > 0).all(1) for p in problems])
    final = np.concatenate([_linearised(_moved(rig, vector), p, vector)[0][p.weight > 0] for p in problems])
    return Correction(vector, covariance, loose_covariance, sigma, int(kept.sum()), float(np.sqrt(np.mean(final**2))))


def _trust(vector: F64) -> F64:
    """(SHARED,) inverse variance of the prior; for the lens's second-order terms that of a Cauchy prior, at most 1 px.

    A good lens needs no displacement and then what is seen is put down to the eyes' rotation; a bad one is believed.
    """
    trust = 1 / PRIOR**2
    lens = np.arange(8, SHARED)
    bent = lens[(lens - 8) % NUISANCE >= 2]
    trust[bent] = np.maximum(trust[bent] / (1 + (vector[bent] / PRIOR[bent]) ** 2), 1.0)
    return trust


def _moved(rig: Rig, vector: F64) -> Rig:
    """The rig with rotation, direction and focal lengths changed; skew and lens displacement are not part of a rig."""
    assert rig.right is not None
    rect_R_left, _ = rectifying_rotations(rig.left_T_right)
    t = rig.left_T_right[:3, 3] + rig.baseline * (vector[DIRECTION] @ rect_R_left[1:])
    transform = np.eye(4)
    transform[:3, :3] = rig.left_T_right[:3, :3] @ se3.so3_exp(vector[ROTATION])
    transform[:3, 3] = t * (rig.baseline / np.linalg.norm(t))
    left = _focal(rig.left, float(np.exp(vector[FOCAL])))
    right = _focal(rig.right, float(np.exp(vector[FOCAL] + vector[FOCAL_RIGHT])))
    return replace(rig, left=left, right=right, left_T_right=transform)


def _focal(camera: Camera, factor: float) -> Camera:
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def _problem(rig: Rig, window: Window) -> _Problem:
    seen = np.isfinite(window.left[0]).all(1) & np.isfinite(window.right[0]).all(1)
    left, right = window.left[:, seen], window.right[:, seen]
    velocity = np.nan_to_num(window.right_velocity[:, seen])
    assert rig.right is not None
    bearing = rig.left.unproject(left[0])
    # (b - rho t) seen from the right eye is parallel to its bearing r: r x R'b = rho r x R't, least squares in rho.
    in_right = rig.right.unproject(right[0])
    rotation, t = rig.left_T_right[:3, :3], rig.left_T_right[:3, 3]
    a, c = np.cross(in_right, bearing @ rotation), np.cross(in_right, t @ rotation)
    rho = (a * c).sum(1) / np.maximum((c * c).sum(1), 1e-12)
    frames = np.broadcast_to(np.eye(4), (len(left), 4, 4)).copy()
    problem = _Problem(left, right, velocity, bearing, rho, frames, np.ones((len(bearing), 4 * len(left))))
    if len(left) > 1:
        frames[1] = _first_pose(rig.left, left[1], bearing, rho)
    return problem


def _first_pose(camera: Camera, uv: F64, bearing: F64, rho: F64) -> F64:
    """frame_T_first (4, 4) by robust Gauss-Newton on the left eye with the points held."""
    pose = np.eye(4)
    seen = np.isfinite(uv[:, 0]) & (np.abs(rho) < 1e3)
    uv, bearing, rho = uv[seen], bearing[seen], rho[seen]
    for _ in range(20):
        p = bearing @ pose[:3, :3].T + rho[:, None] * pose[:3, 3]
        predicted, jac = camera.project_jacobian(p)
        residual = uv - predicted
        good = np.isfinite(residual).all(1)
        if good.sum() < 6:
            return np.eye(4)
        j = np.concatenate([jac * rho[:, None, None], -jac @ se3.skew(p)], -1)[good]
        r = residual[good]
        size = np.linalg.norm(r, axis=1)
        scale = max(float(np.median(size)), 0.3)
        w = (1 / (1 + (size / scale) ** 2))[:, None]
        h = np.einsum("nij,nik,ni->jk", j, j, np.broadcast_to(w, r.shape)) + 1e-6 * np.eye(6)
        step = np.linalg.solve(h, np.einsum("nij,ni->j", j, r * w))
        pose = se3.exp(step) @ pose
    return pose


def _displacement(camera: Camera, uv: F64) -> F64:
    """(N, 2, 9) smooth displacements of about one pixel at the image's border.

    A shift, every second-order term and the first radial one: the first orders of what a lens model can get wrong.
    """
    x, y = 2 * uv[:, 0] / camera.width - 1, 2 * uv[:, 1] / camera.height - 1
    one, zero = np.ones_like(x), np.zeros_like(x)
    aspect = camera.height / camera.width
    r2 = x * x + (aspect * y) ** 2
    u = [one, zero, x * x, x * y, y * y, zero, zero, zero, x * r2]
    v = [zero, one, zero, zero, zero, x * x, x * y, y * y, aspect * y * r2]
    return np.stack([np.stack(u, -1), np.stack(v, -1)], 1)


def _linearised(rig: Rig, problem: _Problem, vector: F64) -> tuple[F64, F64, F64]:
    """Residuals (N, 4 F), derivatives of the prediction by the point (N, 4 F, 3) and by shared and pose (.., S + 6)."""
    assert rig.right is not None
    count, frames = len(problem.bearing), len(problem.left)
    residual = np.full((count, 4 * frames), np.nan)
    by_point = np.zeros((count, 4 * frames, 3))
    by_rest = np.zeros((count, 4 * frames, SHARED + 6))
    rotation, t = rig.left_T_right[:3, :3], rig.left_T_right[:3, 3]
    rect_R_left, _ = rectifying_rotations(rig.left_T_right)
    by_direction = -rig.baseline * (rotation.T @ rect_R_left[1:].T)  # (3, 2) of rho-scaled right coordinates
    tangent = _tangents(problem.bearing)
    rho = problem.rho[:, None]
    for f in range(frames):
        move = problem.frame_T_first[f]
        p = problem.bearing @ move[:3, :3].T + rho * move[:3, 3]
        q = (p - rho * t) @ rotation
        p_point = np.concatenate([move[:3, :3] @ tangent, np.broadcast_to(move[:3, 3, None], (count, 3, 1))], -1)
        q_point = rotation.T @ np.concatenate([p_point[..., :2], p_point[..., 2:] - t[:, None]], -1)
        p_pose = np.concatenate([rho[..., None] * np.eye(3), -se3.skew(p)], -1)
        for eye, camera, points, point_d in ((0, rig.left, p, p_point), (1, rig.right, q, q_point)):
            rows = slice(4 * f + 2 * eye, 4 * f + 2 * eye + 2)
            seen = problem.right[f] if eye else problem.left[f]
            uv, jac = camera.project_jacobian(points)
            shape = _displacement(camera, np.nan_to_num(seen))
            own = slice(8 + eye * NUISANCE, 8 + (eye + 1) * NUISANCE)
            predicted = uv + shape @ vector[own]
            by_point[:, rows] = jac @ point_d
            rest = by_rest[:, rows]
            rest[..., own] = shape
            rest[..., FOCAL] = uv - [camera.cx, camera.cy]
            if eye:
                predicted = predicted + vector[SKEW] * problem.velocity[f]
                rest[..., FOCAL_RIGHT] = rest[..., FOCAL]
                rest[..., SKEW] = problem.velocity[f]
                rest[..., ROTATION] = jac @ se3.skew(q)
                rest[..., DIRECTION] = (jac @ by_direction) * rho[..., None]
                rest[..., SHARED:] = jac @ rotation.T @ p_pose if f else 0.0
            elif f:
                rest[..., SHARED:] = jac @ p_pose
            residual[:, rows] = seen - predicted
    missing = ~np.isfinite(residual) | ~np.isfinite(by_point).all(2) | ~np.isfinite(by_rest).all(2)
    by_point[missing], by_rest[missing], residual[missing] = 0.0, 0.0, np.nan
    return residual, by_point, by_rest


def _tangents(bearing: F64) -> F64:
    """(N, 3, 2) two directions across each bearing."""
    helper = np.where(np.abs(bearing[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(bearing, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.asarray(np.stack([first, np.cross(bearing, first)], -1), float)


def _point_noise(residual: F64) -> F64:
    """(N,) each point's own estimate of the noise of a coordinate, scaled so that the median is unbiased.

    A point's three unknowns leave one of four rows, or five of eight; the medians of chi with one and five degrees of
    freedom are 0.674 and 0.933 of its root mean square.
    """
    rows = np.isfinite(residual).sum(1)
    usable = rows >= 4
    free = rows[usable] - 3
    size = np.sqrt(np.nansum(residual[usable] ** 2, 1) / free)
    return size / np.where(free == 1, 0.674, 0.933)


def _weights(residual: F64, sigma: float, hard: bool) -> F64:
    """Cauchy weights by the worst row of a point; zero for missing rows and, when `hard`, for gross outliers."""
    worst = np.nanmax(np.abs(np.where(np.isfinite(residual), residual, 0.0)), axis=1, keepdims=True)
    weight = 1 / (1 + (worst / (3 * sigma)) ** 2)
    if hard:
        weight = np.where(worst > 6 * sigma, 0.0, weight)
    return np.where(np.isfinite(residual), weight, 0.0)


def _reduced(
    problem: _Problem, residual: F64, by_point: F64, by_rest: F64, sigma: float
) -> tuple[F64, F64, tuple[F64, F64, F64, F64]]:
    """Normal equations of the shared unknowns with the window's points and pose eliminated, and what undoes that."""
    weight = problem.weight / (CORRELATED * sigma) ** 2
    r = np.nan_to_num(residual)
    wp = by_point * weight[..., None]
    h_pp = np.swapaxes(wp, 1, 2) @ by_point + 1e-9 * np.eye(3)
    h_pr = np.swapaxes(wp, 1, 2) @ by_rest  # (N, 3, R)
    g_p = -(np.swapaxes(wp, 1, 2) @ r[..., None])  # (N, 3, 1)
    inverse = np.linalg.inv(h_pp)
    point_gain, point_gradient = inverse @ h_pr, inverse @ g_p
    flat, weights = by_rest.reshape(-1, SHARED + 6), weight.reshape(-1)
    h = flat.T @ (flat * weights[:, None]) - np.einsum("nir,nis->rs", h_pr, point_gain)
    g = -(flat * weights[:, None]).T @ r.reshape(-1) - np.einsum("nir,ni->r", h_pr, point_gradient[..., 0])
    if len(problem.left) == 1:
        return h[:SHARED, :SHARED], g[:SHARED], (np.zeros((6, SHARED)), np.zeros(6), point_gain, point_gradient)
    pose = h[SHARED:, SHARED:] + 1e-6 * np.eye(6)
    pose_gain = np.linalg.solve(pose, h[SHARED:, :SHARED])
    pose_gradient = np.linalg.solve(pose, g[SHARED:])
    reduced = h[:SHARED, :SHARED] - h[:SHARED, SHARED:] @ pose_gain
    return (
        reduced,
        g[:SHARED] - h[:SHARED, SHARED:] @ pose_gradient,
        (pose_gain, pose_gradient, point_gain, point_gradient),
    )


def _apply(problem: _Problem, shared: F64, pose_gain: F64, pose_gradient: F64, gain: F64, gradient: F64) -> None:
    """Back-substitute the shared step into the window's pose and points."""
    pose = -(pose_gradient + pose_gain @ shared)
    rest = np.concatenate([shared, pose])
    step = -(gradient[..., 0] + gain @ rest)
    tangent = _tangents(problem.bearing)
    moved = problem.bearing + (tangent @ step[:, :2, None])[..., 0]
    problem.bearing = moved / np.linalg.norm(moved, axis=1, keepdims=True)
    problem.rho = problem.rho + step[:, 2]
    if len(problem.left) > 1:
        problem.frame_T_first[1] = se3.exp(pose) @ problem.frame_T_first[1]
