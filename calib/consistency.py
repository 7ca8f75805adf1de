"""A small bundle adjustment that estimates a correction of the calibration from points tracked in both cameras.

The unknowns are the rotation of the right camera (3), the direction of the baseline (2), the focal length of both
cameras and of the right one relative to the left (2), the time skew of the right camera (1), a smooth displacement of
each image for errors of the lens model (10 each, with a prior), the motion of each window (6 for each moment after the
first) and the points (bearing and inverse depth, which also represents points at infinity). Points and motions are
eliminated by the Schur complement.

A rotation and a shift of the image, or a focal length and a radial displacement, are strongly correlated. The result is
therefore the rotation and the magnification that the complete correction amounts to at the matches (`calib.amount`);
they are determined much better than the single parameters. The rotation about y is correlated with the magnification of
both cameras, which a recording often cannot show. Unless it is shown to be wrong, it is held in the estimate of the
others; not with one window, whose errors are correlated: its larger covariance stands for that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.amount import FOCAL_BOTH, FOCAL_RATIO, TURN, amounts
from stereo_sfm.calib.choice import Estimate
from stereo_sfm.calib.elimination import OUTLIER_SIGMAS, Eliminated, point_noise, robust_weights
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.scene_model import (
    DIRECTION,
    NUISANCE,
    SHARED,
    Problem,
    in_both,
    linearised,
    make_problem,
    moved,
    part,
)
from stereo_sfm.calib.tracks import Window
from stereo_sfm.types import F64, RIG_TERMS, Bool

HALF_ITERATIONS = 10
# The magnification of both cameras is shown by more than one window, with motion (a share of the image's width) and a
# small standard deviation; it is wrong when it is significant as well.
MIN_TRAVEL, MAX_FOCAL_SIGMA, FOCAL_SIGMAS = 0.04, 0.007, 2.5
CORRELATED = 2.0  # factor on the deviation of the matches' errors, which are not independent
# Prior standard deviations of the rig's corrections: radians, radians, ratios, seconds.
RIG_PRIOR = (0.05, 0.05, 0.05, 0.02, 0.02, 0.05, 0.05, 0.02)


@dataclass(frozen=True)
class Lens:
    """Prior of the displacements from the lens model: one standard deviation in px at the image's border."""

    shift: float
    bend: float  # second order
    radial: tuple[float, float]  # third and fifth order
    heavy_tailed: bool  # a Cauchy prior, at most 5 px wide: strong for good lenses, weak for bad ones

    def information(self, vector: F64) -> F64:
        """(SHARED,) inverse prior variances at the present estimate (SHARED,)."""
        one = (self.shift, self.shift, *[self.bend] * (NUISANCE - 4), *self.radial)
        prior = np.array(RIG_PRIOR + one + one)
        information = 1 / prior**2
        if self.heavy_tailed:
            lens = np.arange(len(RIG_PRIOR), SHARED)
            bent = lens[(lens - len(RIG_PRIOR)) % NUISANCE >= 2]
            information[bent] = np.maximum(information[bent] / (1 + (vector[bent] / prior[bent]) ** 2), 0.04)
        return information


ANY = Lens(0.3, 0.15, (5.0, 2.0), heavy_tailed=True)
# The focal length of both cameras is correlated with the radial displacement. It is estimated with two priors of the
# lens; the difference of the two estimates enters its standard deviation.
CUBIC = Lens(0.3, 0.15, (5.0, 1e-3), heavy_tailed=False)
QUINTIC = Lens(0.3, 0.15, (5.0, 1.0), heavy_tailed=False)


@dataclass(frozen=True, eq=False)
class Correction:
    """The estimated correction of the calibration, with standard deviations."""

    vector: F64  # (SHARED,)
    covariance: F64  # (SHARED, SHARED)
    amount: F64  # (5,) rotation of the right camera in rad, right focal length relative to left, both: `calib.amount`
    amount_sigma: F64  # (5,)
    noise_px: float  # of one measured coordinate, robust
    points: int
    residual_px: float  # root mean square of the inliers after the fit
    travel: float  # largest median motion of a window's points, as a fraction of the image's width
    explained: tuple[Bool, ...]  # for each window (N,) inliers of the corrected rig at the first moment
    whole: Estimate  # of the terms that may be written
    halves: tuple[Estimate, ...]  # the same from each half of the recording
    rolling: bool = False  # rolling shutter: motion distorts the images like an error of the lens model

    @property
    def sigma(self) -> F64:
        """(SHARED,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def shows_focal(self) -> bool:
        """Whether there is enough motion to separate the focal length of both cameras from the lens displacements.

        One window is not enough: the errors of its matches are correlated, which the covariance does not contain.
        """
        return not self.rolling and _shows_focal(len(self.explained), self.travel, self.amount_sigma[FOCAL_BOTH])


@dataclass(frozen=True, eq=False)
class _Fit:
    """One minimum of the cost."""

    vector: F64
    covariance: F64
    sigma: float


def estimate(rig: Rig, windows: list[Window], iterations: int = 18) -> Correction:
    """Fit the correction of `rig` to the windows."""
    problems = [make_problem(rig, w) for w in windows]
    best = _fit(rig, problems, ANY, np.zeros(SHARED), 5.0, iterations)
    final = [linearised(moved(rig, best.vector), p, best.vector)[0][p.weight > 0] for p in problems]
    kept = sum(int((p.weight > 0).all(1).sum()) for p in problems)
    explained = tuple(_explained(w, p) for w, p in zip(windows, problems, strict=True))
    total = amounts(rig, windows)
    both, both_sigma = _both(rig, problems, best, total[FOCAL_BOTH])
    residual = float(np.sqrt(np.mean(np.concatenate(final) ** 2)))
    travel = max(_travel(w) for w in windows) / rig.left.width
    parts = [_fit(rig, half, ANY, best.vector, best.sigma, HALF_ITERATIONS) for half in _halves(problems)]
    fits = [best, *parts]
    wrong = _shows_focal(len(windows), travel, both_sigma) and abs(both) > FOCAL_SIGMAS * both_sigma
    whole, *halves = fits if wrong or len(windows) == 1 else [_held(fit, total[FOCAL_BOTH]) for fit in fits]
    amount, covariance = total @ whole.vector, total @ whole.covariance @ total.T
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    amount[FOCAL_BOTH], sigma[FOCAL_BOTH] = both, both_sigma
    return Correction(
        whole.vector, whole.covariance, amount, sigma, best.sigma, kept, residual, travel, explained,
        _terms(whole, total), tuple(_terms(half, total) for half in halves),
    )  # fmt: skip


def _shows_focal(windows: int, travel: float, sigma: float) -> bool:
    return windows > 1 and travel > MIN_TRAVEL and sigma < MAX_FOCAL_SIGMA


def _held(fit: _Fit, combination: F64) -> _Fit:
    """The fit with a linear combination (SHARED,) of the unknowns held at zero: the conditional Gaussian."""
    across = fit.covariance @ combination
    gain = across / (combination @ across)
    vector = fit.vector - gain * (combination @ fit.vector)
    return _Fit(vector, fit.covariance - np.outer(gain, across), fit.sigma)


def _halves(problems: list[Problem]) -> tuple[list[Problem], list[Problem]]:
    """Even and odd windows; of a single window, even and odd points."""
    if len(problems) > 1:
        return problems[0::2], problems[1::2]
    return [part(problems[0], slice(0, None, 2))], [part(problems[0], slice(1, None, 2))]


def _terms(fit: _Fit, total: F64) -> Estimate:
    """The terms from which `stereo_sfm.calib.choice` selects."""
    by_vector = np.zeros((RIG_TERMS, SHARED))
    by_vector[:3], by_vector[5] = total[TURN], total[FOCAL_RATIO]
    by_vector[3:5, DIRECTION] = np.eye(2)
    unknown = np.diag([*[0.0] * 6, 0.01**2, 0.01**2])  # decentering: the displacements stand for it
    return Estimate(by_vector @ fit.vector, by_vector @ fit.covariance @ by_vector.T + unknown)


def _explained(window: Window, problem: Problem) -> Bool:
    out = in_both(window)
    out[out] = (problem.weight[:, :4] > 0).all(1)
    return out


def _both(rig: Rig, problems: list[Problem], start: _Fit, total: F64) -> tuple[float, float]:
    """Magnification of both cameras and its deviation: mean and half the difference with two priors of the lens."""
    fits = [_fit(rig, problems, lens, start.vector, start.sigma, 8) for lens in (CUBIC, QUINTIC)]
    values = [float(total @ f.vector) for f in fits]
    deviation = max(float(np.sqrt(total @ f.covariance @ total)) for f in fits)
    return 0.5 * sum(values), float(np.hypot(deviation, 0.5 * (values[0] - values[1])))


def _travel(window: Window) -> float:
    """Median over the points of the largest distance from the first position, px of the left image."""
    far = np.linalg.norm(window.left - window.left[0], axis=2)
    return float(np.median(np.nan_to_num(np.fmax.reduce(far, axis=0))))


def _fit(rig: Rig, problems: list[Problem], lens: Lens, vector: F64, sigma: float, iterations: int) -> _Fit:
    """Iteratively reweighted Gauss-Newton; updates the points and motions of `problems` in place."""
    hessian = np.eye(SHARED)
    for iteration in range(iterations):
        current = moved(rig, vector)
        information = lens.information(vector)
        hessian, gradient = np.diag(information), vector * information
        steps: list[tuple[Problem, Eliminated]] = []
        sizes: list[F64] = []
        for problem in problems:
            residual, by_point, by_rest = linearised(current, problem, vector)
            sizes.append(point_noise(residual))
            most = OUTLIER_SIGMAS * sigma if iteration >= iterations // 2 else np.inf
            problem.weight = robust_weights(residual, 3 * sigma, most)
            weight = problem.weight / (CORRELATED * sigma) ** 2
            solved = Eliminated.of(residual, by_point, by_rest, weight, SHARED)
            hessian, gradient = hessian + solved.matrix, gradient + solved.gradient
            steps.append((problem, solved))
        delta = np.asarray(-np.linalg.solve(hessian, gradient), float)
        for problem, solved in steps:
            solved.apply(delta, problem)
        vector = vector + delta
        sigma = float(np.clip(np.median(np.concatenate(sizes)), 0.1, 30.0))
    return _Fit(vector, np.asarray(np.linalg.inv(hessian), float), sigma)
