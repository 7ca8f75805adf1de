"""Length of a step of which only the direction is known: unit steps or ground truth, an explicit choice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.papers.motion_estimator import Motion
from stereo_sfm.types import Trajectory

SCALES = ("stereo", "unit", "ground-truth")


class StepScale:
    """Turns directions into translations."""

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
        """The motion with a length; unchanged where it has one."""
        if motion.metric:
            return motion
        step = 1.0
        if self._kind == "ground-truth" and self._truth is not None:
            step = float(np.linalg.norm(self._position(stamp_ns) - self._position(last_stamp_ns)))
        return replace(motion, translation=step * motion.translation, metric=True)

    def _position(self, stamp_ns: int) -> np.ndarray:
        assert self._truth is not None
        stamps = self._truth.stamp_ns
        return np.array([np.interp(stamp_ns, stamps, self._truth.positions[:, k]) for k in range(3)])
