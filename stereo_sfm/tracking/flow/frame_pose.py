"""The pose of one frame: where it is expected, what motion-only optimisation makes of it, and how far to believe it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np

from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow import pose_solver
from stereo_sfm.tracking.flow.consensus import AGREEMENT, ALERT_S, LEFT, SAME, SETTLED_S, errors_at
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64, Bool

# In sigmas, one Gauss-Newton step each. The last are narrow: what disagrees by two or three sigmas (corners where a
# near edge crosses a far one, people who walk along) errs to one side, and bends the scale.
CAUCHY_SCALES = np.array([20.0, 10.0, 6.0, 4.0, 2.0, 1.0, 1.0])
MEDIAN_ERROR = 0.8  # of unit noise in the four rows of a point
NOISE_RANGE = (0.3, 4.0)  # over config.sigma_px
SURPRISE = (0.01, 4.0), (0.01, 6.0)  # metres and m/s^2, radians and rad/s^2 that no robot is too steady for
MOST_SURPRISE = 5.0  # times what this one's motion did of late
MEMORY_S = 5.0
LEAST_DEPTH_SIGMA = 1e-3  # relative


@dataclass(frozen=True)
class ExpectedMotion:
    """How the camera is expected to have moved since the last frame."""

    pose: F64  # (4, 4) odom_T_cam
    moved: F64  # (6,) tangent from the last frame's pose to this one
    seconds: float  # since the last frame

    @property
    def velocity(self) -> F64:
        """(6,) tangent a second."""
        return self.moved / self.seconds if self.seconds > 0 else np.zeros(6)


@dataclass
class PoseSolution:
    """What motion-only optimisation found."""

    pose: F64  # (4, 4) odom_T_cam
    velocity: F64  # (6,) tangent a second while the rows were read; as expected for a global shutter
    covariance: F64  # (6, 6)
    error: F64  # (N,) whitened
    sigma_px: float  # what it is whitened by
    max_error: float
    reason: str = ""  # why there is no pose
    judges: Bool = field(default_factory=lambda: np.zeros(0, bool))  # (N,) settled points, where they decided

    @property
    def inlier(self) -> Bool:
        """(N,)"""
        return self.error < self.max_error

    @property
    def inliers(self) -> int:
        """How many points agree with the pose."""
        return int(self.inlier.sum())

    @property
    def residual_px(self) -> float:
        """Median over the points; NaN without a pose."""
        return math.nan if self.reason else self.sigma_px * float(np.median(self.error[np.isfinite(self.error)]))

    def good(self, config: TrackerConfig, before: int) -> bool:
        """Whether most of the points that were followed agree."""
        return not self.reason and self.inliers > max(2 * config.min_features, 0.4 * before)


class FramePoseSolver:
    """Solves for the pose of each frame by the noise that the frames before have shown."""

    def __init__(self, config: TrackerConfig, cameras: StereoCameras, shutter: RollingShutter) -> None:
        self._config, self._cameras, self._shutter = config, cameras, shutter
        self._noise = 1.0  # observed noise over config.sigma_px
        self._alert_s = 0.0  # seconds for which something may still move
        self._surprise = np.zeros(2)  # mean square of metres/s^2 and radians/s^2 between expected and found poses

    def use(self, cameras: StereoCameras) -> None:
        """From now on with these cameras."""
        self._cameras = cameras

    def solve(self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64, before: int = 0) -> PoseSolution:
        """Pose from where it is expected; from the previous pose (4, 4) when that finds no consensus.

        Where not everything stands still, settled points decide; without them only an expected pose is believed.
        """
        voters = ~tracks.moving
        if voters.sum() < self._config.min_features:
            return _no_pose(len(tracks), "too_few_points")
        if self.alert:
            return self._on_alert(tracks, expected, last_pose, voters)
        best = self._by_all(tracks, expected, last_pose, voters)
        if best.reason or best.inliers >= max(AGREEMENT * voters.sum(), LEFT * before):
            return best
        settled = self._by_settled(tracks, expected, voters)
        if settled is None or best.inlier[settled.judges].sum() > SAME * settled.inlier[settled.judges].sum():
            return best
        return settled

    def _on_alert(self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64, voters: Bool) -> PoseSolution:
        """Something moves: settled points decide."""
        settled = self._by_settled(tracks, expected, voters)
        if settled is not None:
            return settled
        best = self._by_all(tracks, expected, last_pose, voters)
        likely = best.reason or self._likely(best.pose, expected)
        return best if likely else _no_pose(len(tracks), "no_consensus")

    def _by_all(self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64, voters: Bool) -> PoseSolution:
        """All points have the same say."""
        best = self._optimise(tracks, expected, voters)
        if best.inliers < 0.5 * voters.sum():
            still = ExpectedMotion(last_pose, np.zeros(6), expected.seconds)
            best = max(best, self._optimise(tracks, still, voters), key=lambda s: s.inliers)
        if best.inliers < self._config.min_features:
            best.reason = "no_consensus"
        return best

    def _by_settled(self, tracks: Tracks, expected: ExpectedMotion, voters: Bool) -> PoseSolution | None:
        """Points that have stood still for long decide, the others follow; None where there are too few."""
        settled = voters & (tracks.age * expected.seconds >= SETTLED_S)
        if settled.sum() < self._config.min_features:
            return None
        first = self._optimise(tracks, expected, settled)
        agree = first.inlier & settled
        if agree.sum() < max(self._config.min_features, 0.5 * settled.sum()):
            return None
        start = dataclasses.replace(expected, pose=first.pose)
        solution = self._optimise(tracks, start, first.inlier & voters)
        solution.judges = settled
        return solution

    @property
    def alert(self) -> bool:
        """Whether something moved before the camera within the last second."""
        return self._alert_s > 0

    def _likely(self, pose: F64, expected: ExpectedMotion) -> bool:
        """Whether the camera can be there, given where its motion until now would have taken it."""
        off = np.array(se3.extent(se3.inverse(expected.pose) @ pose))
        least, most = np.array(SURPRISE).T
        most = np.maximum(most, MOST_SURPRISE * np.sqrt(self._surprise))
        return bool((off < least + most * expected.seconds**2).all())

    def learn(self, tracks: Tracks, solution: PoseSolution, before: int, expected: ExpectedMotion) -> None:
        """Follow whether something moves before the camera and, while nothing does, the noise of points and motion.

        `before`: points that stood still until now and were looked for.
        """
        seconds = expected.seconds
        voters = ~tracks.moving
        agree = int(solution.inlier[voters].sum()) >= max(AGREEMENT * voters.sum(), LEFT * before)
        overruled = len(solution.judges) > 0 and not agree
        self._alert_s = ALERT_S if overruled or tracks.moving.any() else max(self._alert_s - seconds, 0.0)
        if self.alert:
            return
        median = float(np.median(solution.error[solution.inlier]))
        noise = self._noise * (0.9 + 0.1 * median / MEDIAN_ERROR)
        self._noise = min(max(noise, NOISE_RANGE[0]), NOISE_RANGE[1])
        if seconds > 0:
            off = np.array(se3.extent(se3.inverse(expected.pose) @ solution.pose)) / seconds**2
            self._surprise += (1.0 - math.exp(-seconds / MEMORY_S)) * (off**2 - self._surprise)

    def refine_depth(self, tracks: Tracks, solution: PoseSolution) -> None:
        """Better distances for the points that agree and that the map has not placed."""
        pose_solver.refine_depth(
            solution.pose, solution.velocity, self._shutter.row_seconds(tracks.uv), tracks.origin, tracks.direction,
            tracks.rho, tracks.variance, tracks.uv, tracks.uv_right, solution.inlier & ~tracks.mapped,
            self._cameras.cams, self._cameras.right_T_left, self._config.depth_sigma_px, LEAST_DEPTH_SIGMA,
        )  # fmt: skip

    def _optimise(self, tracks: Tracks, expected: ExpectedMotion, voters: Bool) -> PoseSolution:
        """The pose by those that have a say (N,), with the errors of all."""
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
