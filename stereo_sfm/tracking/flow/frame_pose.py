"""The pose of one frame: where it is expected, what motion-only optimisation makes of it, and how far to believe it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereo_sfm.config import TrackerConfig
from stereo_sfm.tracking.flow import pose_solver
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64, Bool

# In sigmas, one Gauss-Newton step each. The last are narrow: what disagrees by two or three sigmas (corners where a
# near edge crosses a far one, people who walk along) errs to one side, and bends the scale.
CAUCHY_SCALES = np.array([20.0, 10.0, 6.0, 4.0, 2.0, 1.0, 1.0])
MEDIAN_ERROR = 0.8  # of unit noise in the four rows of a point
NOISE_RANGE = (0.3, 4.0)  # over config.sigma_px
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

    def use(self, cameras: StereoCameras) -> None:
        """From now on with these cameras."""
        self._cameras = cameras

    def solve(self, tracks: Tracks, expected: ExpectedMotion, last_pose: F64) -> PoseSolution:
        """Pose from where it is expected; from the previous pose (4, 4) when that finds no consensus."""
        config = self._config
        if len(tracks) < config.min_features:
            far = np.full(len(tracks), np.inf)
            return PoseSolution(np.eye(4), np.zeros(6), np.eye(6), far, 0.0, 0.0, "too_few_points")
        best = self._optimise(tracks, expected)
        if best.inliers < 0.5 * len(tracks):
            still = ExpectedMotion(last_pose, np.zeros(6), expected.seconds)
            best = max(best, self._optimise(tracks, still), key=lambda s: s.inliers)
        if best.inliers < config.min_features:
            best.reason = "no_consensus"
        return best

    def learn(self, solution: PoseSolution) -> None:
        """Follow the noise of the observations."""
        median = float(np.median(solution.error[solution.inlier]))
        noise = self._noise * (0.9 + 0.1 * median / MEDIAN_ERROR)
        self._noise = min(max(noise, NOISE_RANGE[0]), NOISE_RANGE[1])

    def refine_depth(self, tracks: Tracks, solution: PoseSolution) -> None:
        """Better distances for the points that agree and that the map has not placed."""
        pose_solver.refine_depth(
            solution.pose, solution.velocity, self._shutter.row_seconds(tracks.uv), tracks.origin, tracks.direction,
            tracks.rho, tracks.variance, tracks.uv, tracks.uv_right, solution.inlier & ~tracks.mapped,
            self._cameras.cams, self._cameras.right_T_left, self._config.depth_sigma_px, LEAST_DEPTH_SIGMA,
        )  # fmt: skip

    def _optimise(self, tracks: Tracks, expected: ExpectedMotion) -> PoseSolution:
        sigma_px = self._config.sigma_px * self._noise
        pose, velocity, covariance, error = pose_solver.optimise_pose(
            expected.pose, expected.moved, expected.seconds, self._shutter.velocity_sigma(),
            self._shutter.row_seconds(tracks.uv), tracks.origin, tracks.direction, tracks.rho, tracks.variance,
            tracks.uv, tracks.uv_right, self._cameras.cams, self._cameras.right_T_left, sigma_px, CAUCHY_SCALES,
        )  # fmt: skip
        return PoseSolution(pose, velocity, covariance, error, sigma_px, self._config.max_error_sigmas)
