"""How well roll and pitch can be known: the most likely motion from the same samples and poses, by GTSAM.

Poses, velocities and biases of every image up to a time, with the noise that the simulation has: combined inertial
factors (Forster et al., TRO 2017) and the poses relative to a frame of the odometry that turns from second to second.
What it does not know, nobody knows: before the robot turns, a bias of the accelerometer and a tilt push alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from dead_reckoning import RATE

from stereo_sfm.calib.imu import Imu
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.preintegration import GRAVITY
from stereo_sfm.tracking.inertial.inertial_motion import roll_pitch_deg
from stereo_sfm.tracking.inertial.series import SampleBuffer
from stereo_sfm.types import F64, ImuSamples

FIRST_SIGMA = 0.2, 1e-4  # rad of tilt, and of all that is chosen at the start
STILL = 1e-6  # m: the odometry's frame does not move
NO_BIAS = gtsam.imuBias.ConstantBias(np.zeros(3), np.zeros(3))


@dataclass(frozen=True)
class BestTilt:
    """What is known at one image, from all before it."""

    image: int
    off_deg: F64  # (2,) error of roll and pitch
    sigma_deg: float  # of each


def true_tilt_deg(world_T_cam: F64) -> F64:
    """(2,) roll and pitch of a pose (4, 4) in a world whose z axis is vertical."""
    return np.array(roll_pitch_deg(world_T_cam[:3, :3].T @ np.array([0.0, 0.0, -1.0])))


class TiltGraph:
    """A growing graph: one `add` per image."""

    def __init__(self, imu: Imu, noise: F64, turn: float) -> None:
        """`noise`: (6,) metres and radians of a pose. `turn`: rad by which the odometry turns in a second."""
        self._imu, self._buffer, self._turn = imu, SampleBuffer(imu), turn
        self._noise = _diagonal(np.concatenate([noise[3:], noise[:3]]))
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
        self._params.setGyroscopeCovariance(np.eye(3) * imu.gyro_noise**2)
        self._params.setAccelerometerCovariance(np.eye(3) * imu.accel_noise**2)
        self._params.setIntegrationCovariance(np.eye(3) * 1e-12)
        self._params.setBiasOmegaCovariance(np.eye(3) * imu.gyro_walk**2)
        self._params.setBiasAccCovariance(np.eye(3) * imu.accel_walk**2)
        self._images, self._last_ns = 0, 0
        self._start: F64 = np.eye(4)

    def add(self, stamp_ns: int, samples: ImuSamples | None, odom_T_cam: F64, world_T_cam: F64) -> None:
        """An image; the true pose (4, 4) is where the first search begins and, at the first image, the heading."""
        k, second, imu = self._images, self._images // RATE, self._imu
        if samples is not None:
            self._buffer.add(samples)
        x, v, b, frame = (gtsam.symbol(c, n) for c, n in (("x", k), ("v", k), ("b", k), ("o", second)))
        if k == 0:
            self._start = world_T_cam
            tilt, other = FIRST_SIGMA
            sigmas = np.array([tilt, tilt, tilt, other, other, other])
            self._graph.add(gtsam.PriorFactorPose3(frame, gtsam.Pose3(world_T_cam), _diagonal(sigmas)))
            sigmas = np.repeat([imu.accel_bias_sigma, imu.gyro_bias_sigma], 3)
            self._graph.add(gtsam.PriorFactorConstantBias(b, NO_BIAS, _diagonal(sigmas)))
            self._graph.add(gtsam.PriorFactorVector(v, np.zeros(3), _diagonal(np.full(3, 10.0))))
        if k % RATE == 0:
            self._values.insert(frame, gtsam.Pose3(self._start))
            if k:
                sigmas = np.repeat([self._turn, STILL], 3)
                before = gtsam.symbol("o", second - 1)
                self._graph.add(gtsam.BetweenFactorPose3(before, frame, gtsam.Pose3(), _diagonal(sigmas)))
        seen = gtsam.Pose3(odom_T_cam @ imu.left_T_imu)
        self._graph.add(gtsam.BetweenFactorPose3(frame, x, seen, self._noise))
        self._values.insert(x, gtsam.Pose3(self._start @ odom_T_cam @ imu.left_T_imu))
        self._values.insert(v, np.zeros(3))
        self._values.insert(b, NO_BIAS)
        if k:
            self._link(self._last_ns, stamp_ns, k)
        self._images, self._last_ns = k + 1, stamp_ns

    def _link(self, begin_ns: int, end_ns: int, k: int) -> None:
        intervals = self._buffer.between(begin_ns, end_ns)
        (x, v, b), (next_x, next_v, next_b) = ([gtsam.symbol(c, n) for c in "xvb"] for n in (k - 1, k))
        if intervals is None:  # before the first sample
            self._graph.add(gtsam.BetweenFactorConstantBias(b, next_b, NO_BIAS, _diagonal(np.full(6, 1e-3))))
            return
        motion = gtsam.PreintegratedCombinedMeasurements(self._params, NO_BIAS)
        for seconds, gyro, accel in zip(intervals.seconds, intervals.gyro, intervals.accel, strict=True):
            middle = se3.so3_exp(0.5 * seconds * gyro)  # theirs acts in the axes at the beginning of an interval
            motion.integrateMeasurement(middle @ accel, gyro, seconds)
        self._graph.add(gtsam.CombinedImuFactor(x, v, next_x, next_v, b, next_b, motion))

    def best(self, world_T_cam: F64) -> BestTilt:
        """At the newest image, whose true pose is (4, 4)."""
        self._values = gtsam.LevenbergMarquardtOptimizer(
            self._graph, self._values, gtsam.LevenbergMarquardtParams()
        ).optimize()
        newest = gtsam.symbol("x", self._images - 1)
        world_T_imu = self._values.atPose3(newest).matrix()
        covariance = gtsam.Marginals(self._graph, self._values).marginalCovariance(newest)[:3, :3]
        tilt = (world_T_imu[:3, :3] @ covariance @ world_T_imu[:3, :3].T)[:2, :2]
        off = true_tilt_deg(world_T_imu @ se3.inverse(self._imu.left_T_imu)) - true_tilt_deg(world_T_cam)
        return BestTilt(self._images - 1, off, float(np.degrees(np.sqrt(np.trace(tilt) / 2))))


def _diagonal(sigmas: F64) -> Any:
    return gtsam.noiseModel.Diagonal.Sigmas(sigmas)
