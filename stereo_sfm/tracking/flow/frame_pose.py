"""The pose of one frame: prediction, motion-only optimisation, and the choice between several motions."""

from __future__ import annotations

import math
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.chi_squared import chi_squared
from stereo_sfm.geometry.order_statistics import median
from stereo_sfm.tracking.flow import pose_solver
from stereo_sfm.tracking.flow.consensus import (
    AGREEING_SHARE,
    MIN_GROUP,
    MIN_OPEN_SHARE,
    MIN_WEIGHT,
    STATIC_S,
    SURE_S,
    TRUSTED_OPEN,
    TRUSTED_SHARE,
    WEIGHT_RATIO,
    beside_moving,
    in_group,
)
from stereo_sfm.tracking.flow.motion_prior import DRIFT
from stereo_sfm.tracking.flow.pose_solver import SeenPoints
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64, Bool

# In sigmas, one Gauss-Newton step each. The last are narrow: points that disagree by two or three sigmas (corners where
# a near edge crosses a far one, people who walk along) have one-sided errors, which bias the scale.
CAUCHY_SCALES = np.array([20.0, 10.0, 6.0, 4.0, 2.0, 1.0, 1.0])
MEDIAN_ERROR = 0.8  # of unit noise in the four rows of a point
NOISE_RANGE = (0.3, 10.0)  # over config.sigma_px: the noise of the best images, and what still is a match
# Differences from the prediction that are possible for any robot: metres and m/s^2, radians and rad/s^2.
MIN_LIMITS = (0.01, 4.0), (0.01, 6.0)
# Standard deviations of a robot's differences, or of the recent ones if that is more. What moves before the camera may
# have more points, and older ones, than the store; the camera goes on as before.
USUAL_DIFFERENCES = (0.002, 1.0), (0.002, 1.5)
UNLIKELY = 0.01
USUAL_LIKELIHOOD = 0.6  # about one standard deviation; of a pose less likely the points may be on what moves
# New points on somebody near who hardly moves take a pose along before any is an outlier. Those that are nearer than
# the points known for long by this factor are asked by how many squared sigmas of noise, drift and the rig's error they
# move it away. If by more than has 1 % of six degrees of freedom, 5 % beside moving points, they are compared with the
# pose by the known ones: a point is wrong from so many sigmas on.
NEARER, WRONG_SIGMAS = 1.25, 2.0
# Of the right camera's rotation, with which all distances err: 0 to 0.09 degrees in 15 published calibrations.
RIG_SIGMA = math.radians(0.05)
CONFIRMED_SHARE = 0.75  # of the points of the map that are in view
NEAR_WEIGHT = 0.05  # of all points: so near is one on which more than a degree of freedom of a pose may rest
KNOWN_M = 0.005  # standard deviation of a position by the others with which such a point is left out if it is new
LIMIT_SIGMAS = 5.0  # root mean squares of the recent differences, if that is more
MEMORY_S = 5.0  # time constant of their average
MIN_DEPTH_SIGMA = 1e-3  # relative


@dataclass(frozen=True)
class ExpectedMotion:
    """The predicted motion since the last frame."""

    pose: F64  # (4, 4) odom_T_cam
    moved: F64  # (6,) tangent from the last frame's pose to this one
    seconds: float  # since the last frame

    @property
    def velocity(self) -> F64:
        """(6,) tangent a second."""
        return self.moved / self.seconds if self.seconds > 0 else np.zeros(6)

    def to(self, pose: F64) -> ExpectedMotion:
        """The motion from the last frame's pose to another pose (4, 4) than the expected one."""
        moved = se3.log(se3.exp(self.moved) @ se3.inverse(self.pose) @ pose)
        return replace(self, pose=pose, moved=moved)


@dataclass
class PoseSolution:
    """The result of motion-only optimisation."""

    pose: F64  # (4, 4) odom_T_cam
    velocity: F64  # (6,) tangent a second during the readout; the prediction for a global shutter
    covariance: F64  # (6, 6)
    error: F64  # (N,) whitened
    sigma_px: float  # noise by which it is whitened
    max_error: float
    moving: Bool  # (N,) points that support another motion
    reason: str = ""  # why there is no pose
    blurred: bool = False  # whether the image is blurred, so that its points are good for a pose only

    @property
    def inlier(self) -> Bool:
        """(N,)"""
        return self.error < self.max_error

    @property
    def agreement(self) -> F64:
        """(N,) 1 for a point without error, 0 for outliers (Torr & Zisserman, MLESAC, CVIU 78, 2000, section 3)."""
        if self.reason:
            return np.zeros(len(self.error))
        return np.maximum(1.0 - np.square(self.error / self.max_error), 0.0)

    @property
    def inliers(self) -> int:
        """Number of inliers."""
        return int(np.count_nonzero(self.inlier))

    @property
    def residual_px(self) -> float:
        """Median over the points; NaN without a pose."""
        return math.nan if self.reason else self.sigma_px * float(np.median(self.error[np.isfinite(self.error)]))

    @property
    def consistent(self) -> bool:
        """Whether most of the points that were found agree."""
        return self.inliers >= AGREEING_SHARE * len(self.error)

    def good(self, config: TrackerConfig, before: int) -> bool:
        """Whether enough of the `before` tracked points are inliers."""
        return not self.reason and self.inliers > max(2 * config.min_features, 0.4 * before)


class FramePoseSolver:
    """Solves for the pose of each frame with the noise of the previous frames."""

    def __init__(self, config: TrackerConfig, cameras: StereoCameras, shutter: RollingShutter) -> None:
        self.cameras = cameras  # current ones
        self._config, self._shutter = config, shutter
        self._noise = 1.0  # observed noise over config.sigma_px
        self._alert_s = 0.0  # seconds for which other motions are still searched for
        self.open_view = 0.0  # inliers of an unobstructed view
        self._difference = np.zeros(2)  # mean square of metres/s^2 and radians/s^2 between expected and found poses

    def use(self, cameras: StereoCameras) -> None:
        """Use other cameras."""
        self.cameras = cameras

    def solve_again(self, tracks: Tracks, expected: ExpectedMotion) -> PoseSolution:
        """Solve for the pose of a lost camera from points that were static before, starting at the expected pose."""
        if len(tracks) < self._config.min_features:
            return no_pose(len(tracks), "too_few_points")
        with self._noise_of_at_least(1.0):  # windows that changed much are found less exactly
            return self._solve_all(tracks, expected, expected.pose, np.ones(len(tracks), bool))

    def solve(
        self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64, before: int = 0, blurred: bool = False
    ) -> PoseSolution:
        """Solve for the pose, starting at the prediction; at the previous pose (4, 4) if that finds no consensus.

        `before`: number of static points that were tracked. If many of them disagree or are lost, other motions are
        searched for, and the one that the points tracked longest support is the camera's. `blurred`: the image is.
        """
        if blurred:
            with self._noise_of_at_least(2.0):
                return replace(self.solve(tracks, expected, last_pose, before), blurred=True)
        static = ~tracks.moving
        if np.count_nonzero(static) < self._config.min_features:
            return no_pose(len(tracks), "too_few_points")
        best = self._solve_all(tracks, expected, last_pose, static)
        contradicted = self._contradicted(tracks, expected, best)
        if contradicted is None:
            return self._judge(tracks, expected, last_pose, best, before)
        best, wrong, group = contradicted
        others = replace(tracks, moving=tracks.moving | wrong)
        solution = self._judge(others, expected, last_pose, best, before)
        return replace(solution, moving=solution.moving | group)

    def _contradicted(
        self, tracks: Tracks, expected: ExpectedMotion, best: PoseSolution
    ) -> tuple[PoseSolution, Bool, Bool] | None:
        """The pose without points that points tracked for long contradict; None: there are none.

        Suspected are new points that are nearer, and all beside a moving one. Returns also which are left out (N,), and
        which of them move (N,).
        """
        if best.reason:
            return None
        static, doubtful = ~tracks.moving, beside_moving(tracks)
        known = self._known(tracks, static & ~doubtful, expected.seconds)
        if known is None:
            return None
        near = static & ~known & (tracks.age > 0) & (tracks.rho > NEARER * median(tracks.rho[known]))
        way = median(np.linalg.norm(best.pose[:3, 3] - tracks.origin[known], axis=1))
        drift = np.repeat(np.square(np.multiply(DRIFT, way)), 3)
        if np.count_nonzero(near) < MIN_GROUP or self.shift_chi2(tracks, near, best, drift) < chi_squared(6):
            near[:] = False
        if not doubtful.any() or self.shift_chi2(tracks, doubtful, best, drift) < chi_squared(6, 0.95):
            doubtful[:] = False
        suspected = near | doubtful
        if not suspected.any():
            return None
        by_known = self._optimise(tracks, expected.to(best.pose), known)
        if by_known.inlier[known].sum() < AGREEING_SHARE * known.sum():
            return None
        pose, velocity, _, *others = self._at(by_known, tracks.keep(known))
        moved = by_known.covariance @ pose_solver.by_common_rho(pose, velocity, *others)
        spread = by_known.covariance + np.diag(drift) + self._rho_sigma**2 * np.outer(moved, moved)
        off = np.zeros(len(tracks), bool)
        off[suspected] = self.influence(tracks.keep(suspected), replace(by_known, covariance=spread))[1] > WRONG_SIGMAS
        wrong = doubtful | off if in_group(tracks, off & near).any() else doubtful
        if not wrong.any():
            return None
        best = self._optimise(tracks, expected.to(by_known.pose), static & ~wrong)
        return best, wrong, in_group(tracks, wrong & off)

    def _known(self, tracks: Tracks, static: Bool, seconds: float) -> Bool | None:
        """(N,) the `static` points (N,) that were tracked longest; None: too few."""
        for least_s in (STATIC_S, SURE_S):
            known = static & (tracks.age * seconds >= least_s)
            if np.count_nonzero(known) >= 2 * self._config.min_features:
                return known
        return None

    def _judge(
        self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64, best: PoseSolution, before: int
    ) -> PoseSolution:
        """The pose by all points, or the motion that is the camera's if objects move; none if too few show it."""
        static = ~tracks.moving
        rest = static & ~best.inlier
        undisturbed = np.count_nonzero(in_group(tracks, rest)) < MIN_GROUP and best.inliers >= AGREEING_SHARE * before
        if not best.reason:
            best = self._without_leverage_points(tracks, expected, static, best)
            rest = static & ~best.inlier
        usual = self._likelihood(best.pose, expected) > USUAL_LIKELIHOOD
        if undisturbed and usual and not self.alert:
            return best
        chosen = self._choose(tracks, expected, last_pose, best, rest)
        disturbed = self.alert or bool(chosen.moving.any())
        more = chosen.inlier[static].sum() > WEIGHT_RATIO * best.inlier[static].sum()
        if not (disturbed or more) and self._plausible(best.pose, expected):
            chosen = best
        few = np.count_nonzero(chosen.inlier & static) < MIN_OPEN_SHARE * self.open_view
        if not few or (usual and not disturbed):
            return chosen
        if undisturbed and self._confirmed(best, static & tracks.mapped, 2 * self._config.min_features):
            return best
        known = static & (tracks.mapped | (tracks.age * expected.seconds >= SURE_S))
        usual = self._likelihood(chosen.pose, expected) > USUAL_LIKELIHOOD
        if usual and self._confirmed(chosen, known, MIN_GROUP):
            return chosen
        return no_pose(len(tracks), "too_few_points")

    @contextmanager
    def _noise_of_at_least(self, noise: float) -> Generator[None]:
        """For points that are found less exactly; over config.sigma_px."""
        usual, self._noise = self._noise, max(self._noise, noise)
        yield
        self._noise = usual

    def _confirmed(self, solution: PoseSolution, known: Bool, least: int) -> bool:
        """Whether most of the points known before (N,), and at least so many, agree with a pose."""
        agree = (solution.inlier & known).sum()
        return bool(agree >= max(least, CONFIRMED_SHARE * known.sum()))

    def _choose(
        self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64, best: PoseSolution, rest: Bool
    ) -> PoseSolution:
        """The camera's motion among those of the points; `rest` (N,): the points that disagree with the best."""
        static = ~tracks.moving
        other = self._solve_rest(tracks, expected, last_pose, rest)
        agreed = None if best.reason else self._refit(tracks, expected, best, best.inlier & static, static)
        surest = tracks.age * expected.seconds >= SURE_S
        if np.count_nonzero(static & surest) < self._config.min_features:  # who walks hides what is farther
            surest = tracks.rho < median(tracks.rho[static])
        near = self._errors(tracks, expected.pose, expected.velocity) < 2.0 * self._config.max_error_sigmas
        by_surest, by_near = (self._solve_by(tracks, expected, static & part, static) for part in (surest, near))
        found = [agreed, by_surest, other, by_near]
        plausible = [s for s in found if s is not None and not s.reason and self._plausible(s.pose, expected)]
        if not self.alert and agreed is not None and not self._plausible(agreed.pose, expected):
            # Points that agree with the best pose, too, are no evidence of another: the prediction is wrong.
            plausible = [s for s in plausible if (s.inlier & static & ~best.inlier).sum() >= MIN_GROUP]
        if not plausible:
            # A map update moves its points together, and the pose with them, whatever the motion.
            agree = int((best.inlier & static & tracks.mapped).sum())
            consistent = agree >= max(TRUSTED_SHARE * int(static.sum()), TRUSTED_OPEN * self.open_view)
            return best if consistent or not self.alert else no_pose(len(tracks), "no_consensus")
        weights = [self._support(tracks, s, expected) for s in plausible]
        k = int(np.argmax(weights))
        chosen = plausible[0] if weights[k] <= WEIGHT_RATIO * weights[0] else plausible[k]
        disagree = static & ~chosen.inlier
        grouped = in_group(tracks, disagree)
        for motion in found:
            moving = np.zeros(len(tracks), bool) if motion is None else disagree & motion.inlier
            if (moving & grouped).sum() >= MIN_GROUP:
                chosen.moving = chosen.moving | moving
        return chosen

    def _support(self, tracks: Tracks, solution: PoseSolution, expected: ExpectedMotion) -> float:
        """Of a pose, by the static points that agree, those tracked longest most, and by the expected motion."""
        if solution.reason:
            return 0.0
        weight = tracks.mapped + np.minimum(tracks.age * expected.seconds, SURE_S) / SURE_S + MIN_WEIGHT
        agree = float((weight * solution.agreement)[~tracks.moving].sum())
        return agree * self._likelihood(solution.pose, expected)

    def better(self, found: list[tuple[Tracks, PoseSolution]], expected: ExpectedMotion) -> tuple[Tracks, PoseSolution]:
        """Of several results for one image the one with more inliers; with more support while objects move."""
        return max(found, key=lambda x: self._support(*x, expected) if self.alert else x[1].inliers)

    def _solve_all(self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64, static: Bool) -> PoseSolution:
        """Solve with all points."""
        best = self._optimise(tracks, expected, static)
        if best.inliers < 0.5 * np.count_nonzero(static):
            still = ExpectedMotion(last_pose, np.zeros(6), expected.seconds)
            best = max(best, self._optimise(tracks, still, static), key=lambda s: s.inliers)
        if best.inliers < self._config.min_features:
            best.reason = "no_consensus"
        return best

    def _solve_by(self, tracks: Tracks, expected: ExpectedMotion, by: Bool, static: Bool) -> PoseSolution | None:
        """Solve with a part of the static points, `by` (N,), then with all their inliers; None with too few.

        Called with those that are least likely to move: static for long, or farther than the median while too few have
        been; and with those that are about where the predicted motion takes them.
        """
        if by.sum() < self._config.min_features or by[static].all():
            return None
        return self._refit(tracks, expected, self._optimise(tracks, expected, by, expected), by, static)

    def _without_leverage_points(
        self, tracks: Tracks, expected: ExpectedMotion, static: Bool, pose: PoseSolution
    ) -> PoseSolution:
        """A pose without the points that it rests on alone, if the others contradict them, or know it without new ones.

        A near point at a wrong pixel, or on somebody near, takes the pose of few others, far away, along, and then has
        no error.
        """
        agree = pose.inlier & static
        weight = np.square(tracks.rho)  # of a point for the position
        near = agree & (weight > NEAR_WEIGHT * weight[agree].sum())
        if not near.any():
            return pose
        alone = np.zeros(len(tracks), bool)
        alone[near] = self.influence(tracks.keep(near), pose)[0] > 1.0
        if not alone.any() or np.count_nonzero(agree & ~alone) < MIN_GROUP:
            return pose
        by_others = self._optimise(tracks, expected.to(pose.pose), agree & ~alone)
        if (self.influence(tracks.keep(alone), by_others)[1] >= self._config.max_error_sigmas).any():
            return self._optimise(tracks, expected.to(by_others.pose), static & ~alone)
        new = alone & (tracks.age * expected.seconds < SURE_S)
        if not new.any() or math.sqrt(np.trace(by_others.covariance[:3, :3])) > KNOWN_M:
            return pose
        return self._optimise(tracks, expected.to(by_others.pose), agree & ~new)

    def _solve_rest(self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64, rest: Bool) -> PoseSolution | None:
        """The motion of the points that disagree with all others: of another object, or the camera's."""
        if rest.sum() < MIN_GROUP:
            return None
        still = ExpectedMotion(last_pose, np.zeros(6), expected.seconds)
        starts = [self._optimise(tracks, start, rest) for start in (still, expected)]
        best = max(starts, key=lambda s: s.inlier[rest].sum())
        return self._refit(tracks, expected, best, rest, ~tracks.moving)

    def _refit(
        self, tracks: Tracks, expected: ExpectedMotion, first: PoseSolution, by: Bool, static: Bool
    ) -> PoseSolution | None:
        """The pose by all inliers of a pose that the points `by` gave; None if most of those are outliers."""
        if (first.inlier & by).sum() < max(self._config.min_features, 0.5 * by.sum()):
            return None
        agree = first.inlier & static
        fitted = self._optimise(tracks, expected.to(first.pose), agree, expected)
        return fitted if fitted.inlier[agree].sum() >= 0.5 * agree.sum() else first  # the prediction is wrong

    def crowded(self, static_points: int) -> bool:
        """Whether objects that move hide so much of an open view that new points are needed in every image."""
        return self.alert and static_points < AGREEING_SHARE * self.open_view

    @property
    def alert(self) -> bool:
        """Whether an object moved within the last second."""
        return self._alert_s > 0

    def _plausible(self, pose: F64, expected: ExpectedMotion) -> bool:
        """Whether a pose differs from the predicted one by no more than the recent accelerations explain."""
        off = np.array(se3.extent(se3.inverse(expected.pose) @ pose))
        constant, quadratic = np.array(MIN_LIMITS).T
        quadratic = np.maximum(quadratic, LIMIT_SIGMAS * np.sqrt(self._difference))
        return bool((off < constant + quadratic * expected.seconds**2).all())

    def _likelihood(self, pose: F64, expected: ExpectedMotion) -> float:
        """Of a pose by the recent accelerations and those of a robot, 1 for the predicted one, UNLIKELY at least."""
        off = np.array(se3.extent(se3.inverse(expected.pose) @ pose))
        sigmas = off / self._usual_sigmas(expected, 2.0)
        return max(math.exp(-0.5 * float(np.square(sigmas).sum())), UNLIKELY)

    def _usual_sigmas(self, expected: ExpectedMotion, factor: float) -> F64:
        """(2,) metres and radians: of a robot's differences from the prediction, `factor` times recent ones if more."""
        constant, quadratic = np.array(USUAL_DIFFERENCES).T
        return constant + np.maximum(quadratic, factor * np.sqrt(self._difference)) * expected.seconds**2

    def learn(self, tracks: Tracks, solution: PoseSolution, expected: ExpectedMotion) -> None:
        """Learn whether objects move before the camera and, while none does, the noise of points and motion."""
        seconds = expected.seconds
        moving = np.count_nonzero(tracks.moving) + np.count_nonzero(solution.moving) >= MIN_GROUP
        if self.alert and not moving:  # still there, with new points
            moving = in_group(tracks, ~tracks.moving & ~solution.inlier).sum() >= MIN_GROUP
        self._alert_s = STATIC_S if moving else max(self._alert_s - seconds, 0.0)
        self._learn_noise(tracks, solution, seconds)
        if self.alert:
            return
        share = 1.0 - math.exp(-seconds / MEMORY_S) if self.open_view else 1.0
        self.open_view += share * (solution.inliers - self.open_view)
        if seconds > 0:
            off = np.array(se3.extent(se3.inverse(expected.pose) @ solution.pose)) / seconds**2
            self._difference += (1.0 - math.exp(-seconds / MEMORY_S)) * (off**2 - self._difference)

    def _learn_noise(self, tracks: Tracks, solution: PoseSolution, seconds: float) -> None:
        """From the points that have been static for long, outliers or not: what they show is noise.

        While none is known for so long, from the inliers, unless objects move.
        """
        surely_static = ~tracks.moving & (tracks.age * seconds >= SURE_S) & np.isfinite(solution.error)
        if np.count_nonzero(surely_static) < 2 * self._config.min_features:
            surely_static = solution.inlier
            if self.alert or not surely_static.any():
                return
        noise = self._noise * (0.9 + 0.1 * median(solution.error[surely_static]) / MEDIAN_ERROR)
        self._noise = min(max(noise, NOISE_RANGE[0]), NOISE_RANGE[1])

    def forget(self) -> None:
        """Forget moving objects and the open view: new points are tracked from here on."""
        self._alert_s, self.open_view = 0.0, 0.0

    def refine_depth(self, tracks: Tracks, solution: PoseSolution) -> None:
        """Update the distances of inliers whose position is not from the map."""
        inlier, sigma_px = solution.inlier & ~tracks.mapped, self._config.depth_sigma_px
        pose, velocity = solution.pose, solution.velocity
        pose_solver.refine_depth(pose, velocity, self._seen(tracks), inlier, self.cameras, sigma_px, MIN_DEPTH_SIGMA)

    def _seen(self, tracks: Tracks) -> SeenPoints:
        """The tracks as the solver takes them."""
        return SeenPoints(
            tracks.origin, tracks.direction, tracks.rho, tracks.variance, tracks.uv, tracks.right_on_curve(),
            self._shutter.row_seconds(tracks.uv),
        )  # fmt: skip

    def influence(self, tracks: Tracks, solution: PoseSolution) -> tuple[F64, F64]:
        """`pose_solver.influence` of points on a pose."""
        return pose_solver.influence(*self._at(solution, tracks))

    def shift_chi2(self, tracks: Tracks, points: Bool, s: PoseSolution, drift: F64) -> float:
        """`pose_solver.shift_chi2` of some points (N,) and the other static ones."""
        others = self._seen(tracks.keep(~tracks.moving & ~points))
        return pose_solver.shift_chi2(*self._at(s, tracks.keep(points)), others, drift, self._rho_sigma)

    @property
    def _rho_sigma(self) -> float:
        """1/m, of all inverse distances together, by an error of the rig."""
        return RIG_SIGMA / float(np.linalg.norm(self.cameras.left_T_right[:3, 3]))

    def _at(self, s: PoseSolution, tracks: Tracks) -> tuple[F64, F64, F64, SeenPoints, StereoCameras, float, float]:
        """A pose and points as arguments of the kernels."""
        return s.pose, s.velocity, s.covariance, self._seen(tracks), self.cameras, s.sigma_px, CAUCHY_SCALES[-1]

    def _optimise(
        self, tracks: Tracks, start: ExpectedMotion, static: Bool, prior: ExpectedMotion | None = None
    ) -> PoseSolution:
        """The pose by the points `static` (N,) and a prior, with the errors of all points."""
        if static.all():
            return self._optimise_all(tracks, start, prior)
        best = self._optimise_all(tracks.keep(static), start, prior)
        return replace(best, error=self._errors(tracks, best.pose, best.velocity), moving=np.zeros(len(tracks), bool))

    def _errors(self, tracks: Tracks, pose: F64, velocity: F64) -> F64:
        """(N,) whitened errors of the points at a pose (4, 4), with a velocity (6,) during the readout."""
        sigma_px = self._config.sigma_px * self._noise
        return pose_solver.errors_at(pose, velocity, self._seen(tracks), self.cameras, sigma_px)

    def _optimise_all(self, tracks: Tracks, start: ExpectedMotion, prior: ExpectedMotion | None) -> PoseSolution:
        sigma_px = self._config.sigma_px * self._noise
        sigmas = np.full(6, np.inf) if prior is None else np.repeat(self._usual_sigmas(prior, 1.0), 3)
        pose, velocity, covariance, error = pose_solver.optimise_pose(
            start.pose, start.moved, start.seconds, self._shutter.velocity_sigma(), self._seen(tracks), self.cameras,
            sigma_px, CAUCHY_SCALES, start.pose if prior is None else prior.pose, sigmas,
        )  # fmt: skip
        none = np.zeros(len(error), bool)
        return PoseSolution(pose, velocity, covariance, error, sigma_px, self._config.max_error_sigmas, none)


def no_pose(count: int, reason: str) -> PoseSolution:
    """Of an image with so many points."""
    error, none = np.full(count, np.inf), np.zeros(count, bool)
    return PoseSolution(np.eye(4), np.zeros(6), np.eye(6), error, 0.0, 0.0, none, reason)
