"""Motion estimators: their input and output. `odometry/` has one a file, each with an `ESTIMATOR`."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from stereo_sfm.config import OdometryConfig, estimator_names
from stereo_sfm.errors import StereoSfmError, one_of
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.types import F64, I64, U8, Bool, Message, Trajectory

SCALES = ("stereo", "unit", "ground-truth")
SHIFTS = 8  # random pairings that `refuse_chance` compares with ...
BETTER_THAN_CHANCE = 3.0  # ... and how many times nearer a motion must bring the points


@dataclass(frozen=True, eq=False)
class FramePair(Message):
    """Matches between the left images of a reference view ("last") and the current one ("now"), one row each."""

    bearings_last: F64  # (N, 3) unit
    bearings_now: F64  # (N, 3) unit
    points_last: F64  # (N, 3) metres in the last camera, NaN where the depth is unknown
    points_now: F64  # (N, 3) metres in the current camera, NaN where the depth is unknown
    sigmas_last: F64  # (N,) metres, standard deviation of the stereo depth
    sigmas_now: F64  # (N,)
    pixel_rad: float  # angle of one pixel at the image centre
    image_last: U8  # (H, W)
    image_now: U8  # (H, W)
    frame_id_last: int
    frame_id_now: int

    def rows_with_points(self, least: int) -> I64:
        """Rows with a 3D point on both sides.

        Raises:
            Degenerate: "too_few_points", fewer than `least`.
        """
        rows = np.flatnonzero(np.isfinite(self.points_last[:, 2]) & np.isfinite(self.points_now[:, 2]))
        if len(rows) < least:
            raise Degenerate("too_few_points", f"{len(rows)} matches have depth on both sides")
        return rows

    def marked(self, rows: I64) -> Bool:
        """(N,) True at these rows."""
        return np.isin(np.arange(len(self.bearings_now)), rows)

    @property
    def sigmas(self) -> F64:
        """(N,) metres: joint standard deviation of the difference of both 3D points."""
        return np.hypot(self.sigmas_last, self.sigmas_now)


@dataclass(frozen=True, eq=False)
class Motion(Message):
    """p_now = rotation @ p_last + translation."""

    rotation: F64  # (3, 3)
    translation: F64  # (3,) metres; a unit direction where `metric` is False
    inliers: Bool  # (N,) rows of the pair that agree
    metric: bool = True
    stats: dict[str, float] = field(default_factory=dict[str, float])


class StepScale:
    """Length of a step of which only the direction is known: unit steps or ground truth, an explicit choice."""

    def __init__(self, config: OdometryConfig, ground_truth: Trajectory | None) -> None:
        """Raises:
        StereoSfmError: unknown scale, or ground truth wanted where there is none.
        """
        if config.scale not in SCALES:
            raise StereoSfmError(f"unknown odometry.scale '{config.scale}': choose one of {', '.join(SCALES)}")
        if config.scale == "ground-truth" and ground_truth is None:
            raise StereoSfmError("odometry.scale is ground-truth, but this source has no ground truth: use unit")
        self._kind = config.scale
        self._truth = ground_truth

    def metric(self, motion: Motion, last_stamp_ns: int, stamp_ns: int) -> Motion:
        """The motion with a length; unchanged where it has one.

        Raises:
            Degenerate: "no_scale".
        """
        if motion.metric:
            return motion
        step = 1.0
        if self._kind == "ground-truth" and self._truth is not None:
            known = self._truth.stamp_ns[[0, -1]]
            if not (known[0] <= last_stamp_ns and stamp_ns <= known[1]):
                raise Degenerate("no_scale", "the ground truth does not cover this step")
            step = float(np.linalg.norm(self._position(stamp_ns) - self._position(last_stamp_ns)))
        return replace(motion, translation=step * motion.translation, metric=True)

    def _position(self, stamp_ns: int) -> np.ndarray:
        assert self._truth is not None
        stamps = self._truth.stamp_ns
        return np.array([np.interp(stamp_ns, stamps, self._truth.positions[:, k]) for k in range(3)])


# Motion between the two frames; raises Degenerate, with a short stable word, where the data do not determine it.
Estimator = Callable[[FramePair, np.random.Generator], Motion]


@dataclass(frozen=True)
class EstimatorEntry:
    """The entry of a file of `odometry/`, its `ESTIMATOR`."""

    summary: str
    make: Callable[[OdometryConfig, Camera], Estimator]  # for the images of a camera
    needs_depth: bool  # it turns 3D points of the current frame into motion: a second camera or depth images

    @staticmethod
    def of(
        summary: str, estimate: Callable[[OdometryConfig, FramePair, np.random.Generator], Motion], needs_depth: bool
    ) -> EstimatorEntry:
        """Of one that needs nothing but its settings."""
        return EstimatorEntry(summary, lambda config, camera: partial(estimate, config), needs_depth)


def estimator(name: str) -> EstimatorEntry:
    """The estimator that `--odometry` names.

    Raises:
        StereoSfmError: unknown name.
    """
    one_of(name, ("flow", *estimator_names()), "odometry")
    return importlib.import_module(f"stereo_sfm.papers.odometry.{name.replace('-', '_')}").ESTIMATOR


def thresholds(config: OdometryConfig, sigmas: F64) -> F64:
    """(N,) metres: the fixed inlier bound of equation 11 widened by the uncertainty of each stereo point."""
    return config.inlier_m + config.inlier_sigmas * sigmas


def refuse_chance(moved: F64, bearings_now: F64) -> None:
    """Reject a motion that fits the matches no better than random pairs of the same points.

    Stereo points are so uncertain along their rays that any motion "agrees" with many of them: the number of inliers
    does not reject matches that are all wrong. The angles do, compared with those of the same points in shifted pairs.

    Args:
        moved: (N, 3) points moved by the motion. bearings_now: (N, 3) their observed bearings.

    Raises:
        Degenerate: "no_consensus".
    """
    ray = moved / np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1e-12)
    count = len(ray)

    def off(shift: int) -> float:
        return float(np.median(np.linalg.norm(np.roll(bearings_now, shift, axis=0) - ray, axis=1)))

    chance = float(np.mean([off(shift) for shift in (np.arange(1, SHIFTS + 1) * count // (SHIFTS + 1)).tolist()]))
    if not off(0) < chance / BETTER_THAN_CHANCE:
        raise Degenerate("no_consensus", f"points are {off(0):.3f} rad off, {chance:.3f} when paired at random")


def weights(config: OdometryConfig, sigmas: F64) -> F64 | None:
    """(N,) inverse variances with the fixed bound as floor, or None for the papers' plain means."""
    if not config.weighted:
        return None
    return 1.0 / (sigmas**2 + (0.1 * config.inlier_m) ** 2)
