"""The pose of one frame: prediction, motion-only optimisation, and the decision between points that disagree."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np

from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow import pose_solver
from stereo_sfm.tracking.flow.consensus import (
    ALERT_S,
    EVIDENCE,
    FEW,
    LEAST_SAY,
    LEFT,
    MORE,
    SETTLED_S,
    errors_at,
    in_company,
)
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64, Bool

# In sigmas, one Gauss-Newton step each. The last are narrow: points that disagree by two or three sigmas (corners where
# a near edge crosses a far one, people who walk along) have one-sided errors, which bias the scale.
CAUCHY_SCALES = np.array([20.0, 10.0, 6.0, 4.0, 2.0, 1.0, 1.0])
MEDIAN_ERROR = 0.8  # of unit noise in the four rows of a point
NOISE_RANGE = (0.3, 4.0)  # over config.sigma_px
# Differences from the prediction that are possible for any robot: metres and m/s^2, radians and rad/s^2.
MIN_LIMITS = (0.01, 4.0), (0.01, 6.0)
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


@dataclass
class PoseSolution:
    """The result of motion-only optimisation."""

    pose: F64  # (4, 4) odom_T_cam
    velocity: F64  # (6,) tangent a second during the readout; the prediction for a global shutter
    covariance: F64  # (6, 6)
    error: F64  # (N,) whitened
    sigma_px: float  # noise by which it is whitened
    max_error: float
    reason: str = ""  # why there is no pose
    moving: Bool = field(default_factory=lambda: np.zeros(0, bool))  # (N,) points that move in company; (0,): none

    @property
    def inlier(self) -> Bool:
        """(N,)"""
        return self.error < self.max_error

    @property
    def inliers(self) -> int:
        """Number of inliers."""
        return int(self.inlier.sum())

    @property
    def residual_px(self) -> float:
        """Median over the points; NaN without a pose."""
        return math.nan if self.reason else self.sigma_px * float(np.median(self.error[np.isfinite(self.error)]))

    def good(self, config: TrackerConfig, before: int) -> bool:
        """Whether enough of the `before` tracked points are inliers."""
        return not self.reason and self.inliers > max(2 * config.min_features, 0.4 * before)


class FramePoseSolver:
    """Solves for the pose of each frame with the noise of the previous frames."""

    def __init__(self, config: TrackerConfig, cameras: StereoCameras, shutter: RollingShutter) -> None:
        self._config, self._cameras, self._shutter = config, cameras, shutter
        self._noise = 1.0  # observed noise over config.sigma_px
        self._alert_s = 0.0  # seconds for which something may still move
        self.open_view = 0.0  # points that agree while nothing moves
        self._difference = np.zeros(2)  # mean square of metres/s^2 and radians/s^2 between expected and found poses

    def use(self, cameras: StereoCameras) -> None:
        """Use other cameras."""
        self._cameras = cameras

    def solve(self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64, before: int = 0) -> PoseSolution:
        """Solve for the pose, starting at the prediction; at the previous pose (4, 4) if that finds no consensus.

        `before`: points that stood still until now and were looked for. Where many of them disagree or are gone, other
        motions are looked for, and that counts which the longest followed points agree with.
        """
        voters = ~tracks.moving
        if voters.sum() < self._config.min_features:
            return _no_pose(len(tracks), "too_few_points")
        best = self._by_all(tracks, expected, last_pose, voters)
        rest = voters & ~best.inlier
        calm = in_company(tracks, rest).sum() < FEW and best.inliers >= LEFT * before
        if calm and not self.alert:
            return best
        chosen = self._choose(tracks, expected, last_pose, best, rest)
        if not self.alert and not len(chosen.moving):
            return best
        covered = (chosen.inlier & voters).sum() < EVIDENCE * self.open_view
        return _no_pose(len(tracks), "too_few_points") if covered else chosen

    def _choose(
        self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64, best: PoseSolution, rest: Bool
    ) -> PoseSolution:
        """Of the motions among the points, the camera's; `rest`: what disagrees with the best."""
        voters = ~tracks.moving
        other = self._by_rest(tracks, expected, last_pose, rest)
        agreed = None if best.reason else self._grown(tracks, expected, best, best.inlier & voters, voters)
        found = [agreed, self._by_settled(tracks, expected, voters), other]
        likely = [s for s in found if s is not None and not s.reason and self._likely(s.pose, expected)]
        if not likely:
            return _no_pose(len(tracks), "no_consensus") if self.alert else best
        say = tracks.mapped + np.minimum(tracks.age * expected.seconds, SETTLED_S) / SETTLED_S + LEAST_SAY
        says = [float(say[s.inlier & voters].sum()) for s in likely]
        k = int(np.argmax(says))
        chosen = likely[0] if says[k] <= MORE * says[0] else likely[k]
        for loser in found:
            moving = np.zeros(len(tracks), bool) if loser is None else voters & loser.inlier & ~chosen.inlier
            if in_company(tracks, moving).sum() >= FEW:
                chosen.moving = chosen.moving | moving if len(chosen.moving) else moving
        return chosen

    def _by_all(self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64, voters: Bool) -> PoseSolution:
        """Solve with all points."""
        best = self._optimise(tracks, expected, voters)
        if best.inliers < 0.5 * voters.sum():
            still = ExpectedMotion(last_pose, np.zeros(6), expected.seconds)
            best = max(best, self._optimise(tracks, still, voters), key=lambda s: s.inliers)
        if best.inliers < self._config.min_features:
            best.reason = "no_consensus"
        return best

    def _by_settled(self, tracks: Tracks, expected: ExpectedMotion, voters: Bool) -> PoseSolution | None:
        """Solve with the points that have been static for long, then with all that agree; None with too few."""
        settled = voters & (tracks.age * expected.seconds >= SETTLED_S)
        if settled.sum() < self._config.min_features or settled[voters].all():
            return None
        return self._grown(tracks, expected, self._optimise(tracks, expected, settled), settled, voters)

    def _by_rest(self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64, rest: Bool) -> PoseSolution | None:
        """The motion of the points that disagree with all others: of something else, or the camera's."""
        if rest.sum() < FEW:
            return None
        still = ExpectedMotion(last_pose, np.zeros(6), expected.seconds)
        starts = [self._optimise(tracks, start, rest) for start in (still, expected)]
        best = max(starts, key=lambda s: s.inlier[rest].sum())
        return self._grown(tracks, expected, best, rest, ~tracks.moving)

    def _grown(
        self, tracks: Tracks, expected: ExpectedMotion, first: PoseSolution, by: Bool, voters: Bool
    ) -> PoseSolution | None:
        """The pose that some points gave, by all that agree with it; None where most of those do not."""
        if (first.inlier & by).sum() < max(self._config.min_features, 0.5 * by.sum()):
            return None
        return self._optimise(tracks, dataclasses.replace(expected, pose=first.pose), first.inlier & voters)

    @property
    def alert(self) -> bool:
        """Whether an object moved within the last second."""
        return self._alert_s > 0

    def _likely(self, pose: F64, expected: ExpectedMotion) -> bool:
        """Whether a pose is near enough to the predicted one."""
        off = np.array(se3.extent(se3.inverse(expected.pose) @ pose))
        constant, quadratic = np.array(MIN_LIMITS).T
        quadratic = np.maximum(quadratic, LIMIT_SIGMAS * np.sqrt(self._difference))
        return bool((off < constant + quadratic * expected.seconds**2).all())

    def learn(self, tracks: Tracks, solution: PoseSolution, expected: ExpectedMotion) -> None:
        """Follow whether something moves before the camera and, while nothing does, the noise of points and motion."""
        seconds = expected.seconds
        moving = tracks.moving.sum() + solution.moving.sum() >= FEW
        self._alert_s = ALERT_S if moving else max(self._alert_s - seconds, 0.0)
        if self.alert:
            return
        share = 1.0 - math.exp(-seconds / MEMORY_S) if self.open_view else 1.0
        self.open_view += share * (solution.inliers - self.open_view)
        median = float(np.median(solution.error[solution.inlier]))
        noise = self._noise * (0.9 + 0.1 * median / MEDIAN_ERROR)
        self._noise = min(max(noise, NOISE_RANGE[0]), NOISE_RANGE[1])
        if seconds > 0:
            off = np.array(se3.extent(se3.inverse(expected.pose) @ solution.pose)) / seconds**2
            self._difference += (1.0 - math.exp(-seconds / MEMORY_S)) * (off**2 - self._difference)

    def refine_depth(self, tracks: Tracks, solution: PoseSolution) -> None:
        """Update the distances of inliers whose position is not from the map."""
        pose_solver.refine_depth(
            solution.pose, solution.velocity, self._shutter.row_seconds(tracks.uv), tracks.origin, tracks.direction,
            tracks.rho, tracks.variance, tracks.uv, tracks.uv_right, solution.inlier & ~tracks.mapped,
            self._cameras.cams, self._cameras.right_T_left, self._config.depth_sigma_px, MIN_DEPTH_SIGMA,
        )  # fmt: skip

    def _optimise(self, tracks: Tracks, expected: ExpectedMotion, voters: Bool) -> PoseSolution:
        """The pose by the points `voters` (N,), with the errors of all points."""
        if voters.all():
            return self._optimise_all(tracks, expected)
        best, cameras = self._optimise_all(tracks.keep(voters), expected), self._cameras
        best.error = errors_at(
            best.pose, best.velocity, self._shutter.row_seconds(tracks.uv), tracks.origin, tracks.direction,
            tracks.rho, tracks.variance, tracks.uv, tracks.uv_right, cameras.cams, cameras.right_T_left, best.sigma_px,
        )  # fmt: skip
        return best

    def _optimise_all(self, tracks: Tracks, expected: ExpectedMotion) -> PoseSolution:
        sigma_px = self._config.sigma_px * self._noise
        pose, velocity, covariance, error = pose_solver.optimise_pose(
            expected.pose, expected.moved, expected.seconds, self._shutter.velocity_sigma(),
            self._shutter.row_seconds(tracks.uv), tracks.origin, tracks.direction, tracks.rho, tracks.variance,
            tracks.uv, tracks.uv_right, self._cameras.cams, self._cameras.right_T_left, sigma_px, CAUCHY_SCALES,
        )  # fmt: skip
        return PoseSolution(pose, velocity, covariance, error, sigma_px, self._config.max_error_sigmas)


def _no_pose(count: int, reason: str) -> PoseSolution:
    return PoseSolution(np.eye(4), np.zeros(6), np.eye(6), np.full(count, np.inf), 0.0, 0.0, reason)
