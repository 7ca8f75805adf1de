"""The way without images by IMU and wheels together: an extended Kalman filter from the last pose on.

The IMU carries pose and velocity on, every half second the way by the wheels corrects them: the camera sways on the
robot, so shorter ways say little. Wheels that slip contradict the velocity that the accelerometer carries on: an
innovation test leaves them out until they agree again. Where they turn otherwise than the gyroscope, their way counts
less before.

Error state, 22 numbers: position, velocity, rotation (left tangent), gravity (odometry frame), biases of accelerometer
and gyroscope, logarithm of the wheels' scale and the direction in which they drive.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.imu import Imu
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.preintegration import Preintegrated
from stereo_sfm.tracking.inertial.inertial_filter import InertialState
from stereo_sfm.tracking.inertial.rotation_filter import DOUBTED_CHI2
from stereo_sfm.types import F64

# Rows of the errors of position, velocity, rotation, gravity, both biases, and what the wheels do not know.
P, V, R, G, BA, BG, S = (slice(a, b) for a, b in ((0, 3), (3, 6), (6, 9), (9, 12), (12, 15), (15, 18), (18, 22)))
SLIPS_CHI2 = 50.0  # of three degrees of freedom: from here on it does not count at all


@dataclass(frozen=True, eq=False)
class WheelStep:
    """The way by the wheels over a short time, in wheel axes at its beginning."""

    way: F64  # (3,) m, turned as the gyroscope says
    sigma: float  # m, its standard deviation


class DeadReckoning:
    """Pose and covariance since the last pose from images."""

    def __init__(self, imu: Imu, left_T_wheel: F64, odom_T_imu: F64, state: InertialState, wheels: F64) -> None:
        """Args:
        odom_T_imu: (4, 4) the last pose. state: what is known there.
        wheels: (4, 4) covariance of the wheels' logarithmic scale and direction.
        """
        self._imu, self._imu_T_wheel = imu, se3.inverse(imu.left_T_imu) @ left_T_wheel
        self._rotation, self._position = odom_T_imu[:3, :3].copy(), odom_T_imu[:3, 3].copy()
        self._velocity, self._gravity = state.velocity.copy(), state.gravity.copy()
        self._accel_bias, self._gyro_bias = state.accel_bias.copy(), state.gyro_bias.copy()
        self._lasting: F64 = np.zeros(4)  # of the wheels
        self._p: F64 = np.zeros((22, 22))
        known = np.r_[3:6, 9:15]
        self._p[np.ix_(known, known)] = state.covariance
        self._p[BG, BG] = state.gyro_bias_sigma**2 * np.eye(3)
        self._p[S, S] = wheels

    def advance(self, m: Preintegrated, wheels: WheelStep | None) -> None:
        """An interval of the IMU, and the way of the wheels in it."""
        if wheels is not None:
            self._correct(m, wheels)
        self._carry_on(m)

    def after(self, m: Preintegrated | None) -> tuple[F64, F64]:
        """odom_T_cam (4, 4) after a further interval of the IMU alone, and its covariance as that of a `Frame`."""
        later = copy(self)
        if m is not None:
            later._carry_on(m)
        return later._pose()

    def _pose(self) -> tuple[F64, F64]:
        odom_T_imu = se3.from_rotation_translation(self._rotation, self._position)
        odom_T_cam = odom_T_imu @ se3.inverse(self._imu.left_T_imu)
        cam_R_odom = odom_T_cam[:3, :3].T
        by = np.zeros((6, 22))  # the camera moves with the IMU's rotation about the IMU
        by[:3, P], by[:3, R] = cam_R_odom, -cam_R_odom @ se3.skew(odom_T_cam[:3, 3] - self._position)
        by[3:, R] = cam_R_odom
        return odom_T_cam, by @ self._p @ by.T

    def _correct(self, m: Preintegrated, wheels: WheelStep) -> None:
        """The way of the wheels' origin in the odometry frame, by the state and by the wheels."""
        t, lever = m.seconds, self._imu_T_wheel[:3, 3]
        pushed = self._rotation @ m.position_with(self._gyro_bias, self._accel_bias)
        swung = self._rotation @ (m.rotation_with(self._gyro_bias) @ lever - lever)
        odom_R_wheel = self._rotation @ self._imu_T_wheel[:3, :3]
        lasting = np.column_stack([wheels.way, -se3.skew(wheels.way)])
        seen = odom_R_wheel @ (wheels.way + lasting @ self._lasting)
        off = seen - (self._velocity * t + 0.5 * self._gravity * t * t + pushed + swung)
        h = np.zeros((3, 22))
        h[:, V], h[:, G], h[:, BA] = t * np.eye(3), 0.5 * t * t * np.eye(3), self._rotation @ m.position_by_accel
        h[:, R] = -se3.skew(pushed + swung - seen)
        h[:, S] = -odom_R_wheel @ lasting
        s = h @ self._p @ h.T + wheels.sigma**2 * np.eye(3)
        chi2 = float(off @ np.linalg.solve(s, off))
        if chi2 > SLIPS_CHI2:
            return
        s *= max(chi2 / DOUBTED_CHI2, 1.0)
        gain = self._p @ h.T @ np.linalg.inv(s)
        self._add(gain @ off)
        p = self._p - gain @ s @ gain.T
        self._p = 0.5 * (p + p.T)

    def _add(self, d: F64) -> None:
        self._position, self._velocity = self._position + d[P], self._velocity + d[V]
        self._rotation = np.asarray(se3.so3_exp(d[R])) @ self._rotation
        self._gravity, self._accel_bias = self._gravity + d[G], self._accel_bias + d[BA]
        self._gyro_bias, self._lasting = self._gyro_bias + d[BG], self._lasting + d[S]

    def _carry_on(self, m: Preintegrated) -> None:
        """Pose and velocity by the IMU (Forster et al., equations 37 and A.7 to A.9)."""
        t, rotation, imu = m.seconds, self._rotation, self._imu
        fast = rotation @ m.velocity_with(self._gyro_bias, self._accel_bias)
        far = rotation @ m.position_with(self._gyro_bias, self._accel_bias)
        f = np.eye(22)
        f[P, V], f[P, G], f[V, G] = t * np.eye(3), 0.5 * t * t * np.eye(3), t * np.eye(3)
        f[P, R], f[V, R] = -se3.skew(far), -se3.skew(fast)
        f[P, BA], f[P, BG] = rotation @ m.position_by_accel, rotation @ m.position_by_gyro
        f[V, BA], f[V, BG] = rotation @ m.velocity_by_accel, rotation @ m.velocity_by_gyro
        turn = m.rotation_with(self._gyro_bias)
        f[R, BG] = rotation @ turn @ m.rotation_by_gyro
        into = np.zeros((22, 9))  # the noise is of rotation (right tangent), velocity, position
        into[R, :3], into[V, 3:6], into[P, 6:] = rotation @ turn, rotation, rotation
        p = f @ self._p @ f.T + into @ m.covariance @ into.T
        p[BA, BA] += imu.accel_walk**2 * t * np.eye(3)
        p[BG, BG] += imu.gyro_walk**2 * t * np.eye(3)
        self._p = 0.5 * (p + p.T)
        self._position = self._position + self._velocity * t + 0.5 * self._gravity * t * t + far
        self._velocity = self._velocity + self._gravity * t + fast
        self._rotation = rotation @ turn
