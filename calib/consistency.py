"""A small bundle adjustment that asks points seen by both eyes, several times, how the calibration should change.

Unknown are the rotation of the right eye (3), the direction of the baseline (2), the focal length of both eyes and of
the right one alone (2), the time skew of the right eye (1), a smooth displacement of each image for the lens's own
imperfection (9 each, held small by a prior with a heavy tail), the motion of each window (6 for each moment after the
first) and the points (bearing and inverse depth, so that points at infinity and beyond stay what they are). Points and
motions are eliminated by the Schur complement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.rig import Rig
from calib.scene_model import NUISANCE, SHARED, Problem, linearised, make_problem, moved, tangents
from calib.tracks import Window
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

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
        return moved(rig, self.vector)


def estimate(rig: Rig, windows: list[Window], iterations: int = 18) -> Correction:
    """Fit the correction of `rig` to the windows."""
    problems = [make_problem(rig, w) for w in windows]
    vector, hessian = np.zeros(SHARED), np.eye(SHARED)
    sigma = 5.0
    for iteration in range(iterations):
        current = moved(rig, vector)
        trust = _trust(vector)
        hessian, gradient = np.diag(trust), vector * trust
        steps: list[tuple[Problem, _Solved]] = []
        sizes: list[F64] = []
        for problem in problems:
            residual, by_point, by_rest = linearised(current, problem, vector)
            sizes.append(_point_noise(residual))
            problem.weight = _weights(residual, sigma, hard=iteration >= 9)
            h, g, solved = _reduced(problem, residual, by_point, by_rest, sigma)
            hessian, gradient = hessian + h, gradient + g
            steps.append((problem, solved))
        delta = np.asarray(-np.linalg.solve(hessian, gradient), float)
        for problem, solved in steps:
            _apply(problem, delta, solved)
        vector = vector + delta
        sigma = float(np.clip(np.median(np.concatenate(sizes)), 0.1, 30.0))
    covariance = np.asarray(np.linalg.inv(hessian), float)
    loose = hessian.copy()
    lens = np.arange(8, SHARED)
    loose[lens, lens] += 1 / np.maximum(0.5, np.abs(vector[8:])) ** 2 - _trust(vector)[8:]
    loose_covariance = np.asarray(np.linalg.inv(loose), float)
    kept = np.concatenate([(p.weight > 0).all(1) for p in problems])
    final = np.concatenate([linearised(moved(rig, vector), p, vector)[0][p.weight > 0] for p in problems])
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


def _point_noise(residual: F64) -> F64:
    """(N,) each point's own estimate of the noise of a coordinate, scaled so that the median is unbiased.

    A point's three unknowns leave one of four rows, five of eight, and so on; the median of chi-squared with k degrees
    of freedom is k (1 - 2 / 9k)^3 (Wilson and Hilferty, PNAS 17, 1931).
    """
    rows = np.isfinite(residual).sum(1)
    usable = rows >= 4
    free = rows[usable] - 3
    size = np.sqrt(np.nansum(residual[usable] ** 2, 1) / free)
    return size / (1 - 2 / (9 * free)) ** 1.5


def _weights(residual: F64, sigma: float, hard: bool) -> F64:
    """Cauchy weights by the worst row of a point at a moment; zero where missing and, when `hard`, for gross outliers."""
    count, rows = residual.shape
    size = np.abs(np.nan_to_num(residual)).reshape(count, rows // 4, 4).max(2)
    worst = np.repeat(size, 4, axis=1)
    weight = 1 / (1 + (worst / (3 * sigma)) ** 2)
    if hard:
        weight = np.where(worst > 6 * sigma, 0.0, weight)
    return np.where(np.isfinite(residual), weight, 0.0)


@dataclass(frozen=True, eq=False)
class _Solved:
    """What gives a window's own step once the shared one is known: step = -(gradient + gain @ the rest's step)."""

    pose_gain: F64  # (6 (F - 1), SHARED)
    pose_gradient: F64
    point_gain: F64  # (N, 3, R)
    point_gradient: F64  # (N, 3)


def _reduced(problem: Problem, residual: F64, by_point: F64, by_rest: F64, sigma: float) -> tuple[F64, F64, _Solved]:
    """Normal equations of the shared unknowns with the window's points and poses eliminated."""
    weight = problem.weight / (CORRELATED * sigma) ** 2
    r = np.nan_to_num(residual)
    wp = np.swapaxes(by_point * weight[..., None], 1, 2)
    h_pp = wp @ by_point
    damping = 1e-9 + 1e-9 * np.trace(h_pp, axis1=1, axis2=2)
    inverse = np.linalg.inv(h_pp + damping[:, None, None] * np.eye(3))
    h_pr = wp @ by_rest  # (N, 3, R)
    point_gain, point_gradient = inverse @ h_pr, -(inverse @ (wp @ r[..., None]))[..., 0]
    flat, weights = by_rest.reshape(-1, by_rest.shape[2]), weight.reshape(-1)
    h = flat.T @ (flat * weights[:, None]) - np.tensordot(h_pr, point_gain, ((0, 1), (0, 1)))
    g = -(flat * weights[:, None]).T @ r.reshape(-1) - np.tensordot(h_pr, point_gradient, ((0, 1), (0, 1)))
    own = h[SHARED:, SHARED:] + 1e-6 * np.eye(len(h) - SHARED)
    pose_gain, pose_gradient = np.linalg.solve(own, h[SHARED:, :SHARED]), np.linalg.solve(own, g[SHARED:])
    solved = _Solved(pose_gain, pose_gradient, point_gain, point_gradient)
    across = h[:SHARED, SHARED:]
    return h[:SHARED, :SHARED] - across @ pose_gain, g[:SHARED] - across @ pose_gradient, solved


def _apply(problem: Problem, shared: F64, solved: _Solved) -> None:
    """Back-substitute the shared step into the window's poses and points."""
    pose = -(solved.pose_gradient + solved.pose_gain @ shared)
    step = -(solved.point_gradient + solved.point_gain @ np.concatenate([shared, pose]))
    directions = tangents(problem.bearing)
    turned = problem.bearing + (directions @ step[:, :2, None])[..., 0]
    problem.bearing = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    problem.rho = problem.rho + step[:, 2]
    for f, twist in enumerate(pose.reshape(-1, 6), 1):
        problem.frame_T_first[f] = se3.exp(twist) @ problem.frame_T_first[f]
