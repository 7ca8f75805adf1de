"""Velocity, gravity and biases from the poses of the last seconds and what the IMU measured between them.

Stereo knows the size of the motion, so that everything but the rotation is linear: the initialization of Qin and Shen
(Robust Initialization of Monocular Visual-Inertial Estimation, IROS 2017) without its scale, over a sliding window. The
rotation of the odometry drifts; what of it tilts gravity, the accelerometer shows, and the gyroscope's bias, which is
found from those rotations, is corrected by it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.preintegration import GRAVITY, Preintegrated
from stereo_sfm.types import F64

LONGEST_S = 10.0  # of the window
LEAST_S = 1.5  # of motion before velocity and gravity count as known
POSITION_SIGMA_M = 0.0015  # of one pose against the next
ROTATION_SIGMA = 5e-4  # rad, the same
GRAVITY_SIGMA = 0.02  # m/s^2 of its size, which varies over the earth
GYRO_BIAS_SIGMA, ACCEL_BIAS_SIGMA = 0.05, 0.3  # rad/s and m/s^2, what is expected of a sensor
DRIFT_SIGMA = 1e-3  # rad/s, of the odometry's rotation
STEPS = 3  # of the linearised size of gravity


@dataclass(frozen=True, eq=False)
class InertialState:
    """What the window says at its newest pose."""

    velocity: F64  # (3,) m/s of the IMU, odometry frame
    gravity: F64  # (3,) m/s^2, odometry frame; points down
    gyro_bias: F64  # (3,) rad/s
    accel_bias: F64  # (3,) m/s^2
    covariance: F64  # (9, 9) of velocity, gravity, accelerometer bias
    gyro_bias_sigma: float  # rad/s


class InertialWindow:
    """Poses (odom_T_imu) and the preintegrated motions between them, oldest first."""

    def __init__(self) -> None:
        self._poses: list[F64] = []
        self._motions: list[Preintegrated] = []

    @property
    def seconds(self) -> float:
        """How much time it covers."""
        return sum(m.seconds for m in self._motions)

    def begin(self, odom_T_imu: F64) -> None:
        """A first pose; nothing before it counts."""
        self._poses, self._motions = [odom_T_imu], []

    def add(self, motion: Preintegrated, odom_T_imu: F64) -> None:
        """The next pose and the motion to it."""
        self._poses.append(odom_T_imu)
        self._motions.append(motion)
        while self.seconds > LONGEST_S:
            del self._poses[0], self._motions[0]

    def gyro_bias(self) -> tuple[F64, float]:
        """(3,) rad/s and its standard deviation: what makes the integrated rotations those of the poses."""
        information, rhs = np.eye(3) / GYRO_BIAS_SIGMA**2, np.zeros(3)
        for (i, j), m in zip(zip(self._poses, self._poses[1:], strict=False), self._motions, strict=True):
            seen = m.rotation.T @ i[:3, :3].T @ j[:3, :3]
            variance = 2 * ROTATION_SIGMA**2 + float(m.covariance[0, 0])
            jacobian = m.rotation_by_gyro
            information += jacobian.T @ jacobian / variance
            rhs += jacobian.T @ (se3.so3_log(seen) + jacobian @ m.gyro_bias) / variance
        sigma = float(np.sqrt(np.trace(np.linalg.inv(information)) / 3))
        return np.linalg.solve(information, rhs).astype(np.float64), sigma

    def estimate(self) -> InertialState | None:
        """None while the window is too short."""
        if self.seconds < LEAST_S:
            return None
        gyro_bias, gyro_sigma = self.gyro_bias()
        gravity, n = self._first_gravity(), len(self._poses)
        g = slice(3 * n, 3 * n + 3)
        normal, x = np.zeros((0, 0)), np.zeros(0)
        for _ in range(STEPS):  # the size of gravity is known: linearised along its direction, as is its drift
            normal, target = self._normal_equations(gyro_bias, gravity)
            down = gravity / np.linalg.norm(gravity)
            normal[g, g] += np.outer(down, down) / GRAVITY_SIGMA**2
            target[g] += down * GRAVITY / GRAVITY_SIGMA**2
            x = np.linalg.solve(normal, target).astype(np.float64)
            gravity = x[g]
        inverse = np.linalg.inv(normal).astype(np.float64)
        keep = np.r_[3 * n - 3 : 3 * n + 6]
        gyro_bias = gyro_bias + self._poses[-1][:3, :3].T @ x[-3:]
        gyro_sigma = float(np.hypot(gyro_sigma, np.sqrt(np.trace(inverse[-3:, -3:]) / 3)))
        return InertialState(
            velocity=x[3 * n - 3 : 3 * n].copy(),
            gravity=gravity.copy(),
            gyro_bias=gyro_bias,
            accel_bias=x[-6:-3].copy(),
            covariance=inverse[np.ix_(keep, keep)],
            gyro_bias_sigma=gyro_sigma,
        )

    def _first_gravity(self) -> F64:
        """Opposite to the mean specific force: right to the mean acceleration."""
        force = sum(p[:3, :3] @ m.velocity for p, m in zip(self._poses, self._motions, strict=False))
        return -np.asarray(force) / self.seconds

    def _normal_equations(self, gyro_bias: F64, gravity: F64) -> tuple[F64, F64]:
        """Of velocities (N, 3), gravity at the newest pose, accelerometer bias, drift of the rotation (rad/s): matrix,
        right-hand side."""
        n = len(self._poses)
        size = 3 * n + 9
        normal, rhs = np.zeros((size, size)), np.zeros(size)
        normal[-6:-3, -6:-3] += np.eye(3) / ACCEL_BIAS_SIGMA**2
        normal[-3:, -3:] += np.eye(3) / DRIFT_SIGMA**2
        since = -self.seconds  # from the newest pose
        for k, m in enumerate(self._motions):
            i, j, t = self._poses[k], self._poses[k + 1], m.seconds
            i_R_odom = i[:3, :3].T
            tilt = -se3.skew(gravity) * (since + 0.5 * t)  # of gravity by the drift until the newest pose
            since += t
            # velocities i and j, gravity, bias, drift -> position and velocity in the axes of i
            jacobian = np.zeros((6, 15))
            jacobian[:3, :3], jacobian[:3, 6:9] = i_R_odom * t, 0.5 * i_R_odom * t * t
            jacobian[:3, 9:12], jacobian[:3, 12:] = m.position_by_accel, 0.5 * i_R_odom @ tilt * t * t
            jacobian[3:, :3], jacobian[3:, 3:6], jacobian[3:, 6:9] = -i_R_odom, i_R_odom, -i_R_odom * t
            jacobian[3:, 9:12], jacobian[3:, 12:] = -m.velocity_by_accel, -i_R_odom @ tilt * t
            zero = np.zeros(3)
            moved = i_R_odom @ (j[:3, 3] - i[:3, 3]) - m.position_with(gyro_bias, zero)
            known = np.concatenate([moved, m.velocity_with(gyro_bias, zero)])
            covariance = m.covariance[3:, 3:][np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])].copy()
            covariance[:3, :3] += 2 * POSITION_SIGMA_M**2 * np.eye(3)
            # A pose that is turned by an error turns the force with it.
            covariance[3:, 3:] += (ROTATION_SIGMA * GRAVITY * t) ** 2 * np.eye(3)
            weight = np.linalg.inv(covariance)
            at = np.r_[3 * k : 3 * k + 6, 3 * n : 3 * n + 9]
            normal[np.ix_(at, at)] += jacobian.T @ weight @ jacobian
            rhs[at] += jacobian.T @ weight @ known
        return normal, rhs
