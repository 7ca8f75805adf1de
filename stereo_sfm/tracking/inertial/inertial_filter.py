"""Velocity, gravity and biases from the tracked poses and what the IMU measured between them: a Kalman filter.

Stereo knows the size of the motion, so that everything but the rotation is linear: the equations of Qin and Shen
(Robust Initialization of Monocular Visual-Inertial Estimation, IROS 2017) without the scale, one motion after the
other. The rotation of the odometry drifts, and with it the direction of gravity in the odometry frame: the gyroscope
carries it on. A bias of the accelerometer turns with the robot. So the two come apart where the robot turns, and stay
known afterwards; before, gravity is as exact as that bias was known when the sensor was switched on.
The gyroscope's bias is found from the rotations of the odometry, and corrected by the drift that gravity shows.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.imu import TURN_SHARE, Imu
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.kernels import inner, njit
from stereo_sfm.geometry.preintegration import GRAVITY, Preintegrated
from stereo_sfm.types import F64

MIN_S = 1.5  # of motion before velocity and gravity are used
POSITION_SIGMA_M, ROTATION_SIGMA = 0.0015, 5e-4  # m and rad of one pose
POSITION_WALK = 0.0015  # m/sqrt(s) of the odometry
GRAVITY_SIGMA = 0.02  # m/s^2 of its size, which varies over the earth
DRIFT_SIGMA, DRIFT_S = 2e-4, 10.0  # rad/s of the odometry's rotation, and seconds for which it stays the same
ROTATION_WALK = 1e-4  # rad/sqrt(s) of the odometry's rotation, at least
KNOWN = 1.0  # m/s^2, standard deviation of gravity from which its size counts
FIRST_DRIFT_SIGMA = 1e-3  # rad/s, before the rotations have shown the gyroscope's bias better
SPEED_SIGMA = 10.0  # m/s, before anything is known: more than any robot's
WRONG_CHI2 = 25.0  # of a motion's three positions: it counts less, as far as that is exceeded
FORCE_S = 5.0  # over which the mean force is taken


@dataclass(frozen=True, eq=False)
class InertialState:
    """What is known at the newest pose."""

    velocity: F64  # (3,) m/s of the IMU, odometry frame
    gravity: F64  # (3,) m/s^2, odometry frame; points down
    gyro_bias: F64  # (3,) rad/s
    accel_bias: F64  # (3,) m/s^2
    covariance: F64  # (9, 9) of velocity, gravity, accelerometer bias
    gyro_bias_sigma: float  # rad/s

    @property
    def tilt_sigma(self) -> float:
        """Radians, standard deviation of the direction of gravity about each horizontal axis."""
        down = self.gravity / np.linalg.norm(self.gravity)
        block = self.covariance[3:6, 3:6]
        return float(np.sqrt(max(np.trace(block) - down @ block @ down, 0.0) / 2)) / GRAVITY


class InertialFilter:
    """Poses (odom_T_imu) and the preintegrated motions between them, one after the other."""

    def __init__(self, imu: Imu) -> None:
        self._imu = imu
        self._newest: F64 = np.eye(4)
        self._seconds = 0.0
        # Velocity, gravity, accelerometer bias, drift of the odometry's rotation (rad/s), error of the newest position.
        self._x: F64 = np.zeros(15)
        self._p: F64 = np.zeros((15, 15))
        self._bias: F64 = np.zeros(3)  # of the gyroscope, by the rotations of the odometry
        self._bias_p: F64 = np.eye(3) * imu.gyro_bias_sigma**2
        self._force: F64 = np.zeros(3)  # mean, odometry frame
        self._forget()

    def _forget(self) -> None:
        """Keep the biases alone."""
        bias = self._imu.accel_bias_sigma
        sigmas = np.repeat([SPEED_SIGMA, 2 * GRAVITY, bias, FIRST_DRIFT_SIGMA, POSITION_SIGMA_M], 3)
        known = self._p[6:9, 6:9].copy() if self._seconds else np.eye(3) * bias**2
        self._p = np.diag(sigmas**2)
        self._p[6:9, 6:9] = known
        self._x = np.concatenate([np.zeros(6), self._x[6:9], np.zeros(6)])
        self._seconds, self._force = 0.0, np.zeros(3)

    def begin(self, odom_T_imu: F64) -> None:
        """A pose that does not go with those before: only the biases are kept."""
        self._newest = odom_T_imu
        self._forget()

    @property
    def force(self) -> float:
        """m/s^2, size of the mean force of the last seconds: gravity's, if the accelerometer is right."""
        return float(np.linalg.norm(self._force)) if self._seconds >= FORCE_S else GRAVITY

    def add(self, motion: Preintegrated, odom_T_imu: F64) -> float:
        """The next pose and the motion to it. Returns chi-squared (of three) of the pose against what was expected."""
        imu, t = self._imu, motion.seconds
        self._turn(motion, odom_T_imu)
        link = _link(motion, self._newest, odom_T_imu, self._bias)
        acceleration = self._newest[:3, :3] @ link[1][3:] / t
        if not self._seconds:
            self._x[3:6], self._force = -acceleration, acceleration
        self._force = self._force + t / min(self._seconds + t, FORCE_S) * (acceleration - self._force)
        rotation = np.ascontiguousarray(self._newest[:3, :3])
        self._x, self._p, chi2 = _advance(self._x, self._p, t, rotation, *link, imu.accel_walk**2 * t)
        self._carry(motion, odom_T_imu)
        self._newest = odom_T_imu
        self._seconds += t
        return float(chi2)

    def _carry(self, m: Preintegrated, odom_T_imu: F64) -> None:
        """Turn the state with the odometry frame, which turns where the images see another rotation than the gyroscope:
        as far as this one is more accurate."""
        t, turn = m.seconds, m.rotation_with(self._bias)
        off = se3.so3_log(odom_T_imu[:3, :3] @ (self._newest[:3, :3] @ turn).T)
        by_images = ROTATION_WALK**2 * t + float(off @ off) / 3
        share = TURN_SHARE * float(np.linalg.norm(se3.so3_log(turn)))
        by_gyro = self._imu.gyro_noise**2 * t + share**2 + float(np.trace(self._bias_p)) / 3 * t * t
        trust = by_images / (by_images + by_gyro)
        rotation = np.eye(15)
        for k in (0, 3, 9, 12):
            rotation[k : k + 3, k : k + 3] = se3.so3_exp(trust * off)
        self._x, self._p = rotation @ self._x, rotation @ self._p @ rotation.T
        self._p[3:6, 3:6] += trust * by_gyro * GRAVITY**2 * np.eye(3)

    def _turn(self, m: Preintegrated, odom_T_imu: F64) -> None:
        """Learn the gyroscope's bias from a rotation."""
        p = self._bias_p + np.eye(3) * (self._imu.gyro_walk**2 * m.seconds)
        seen = se3.so3_log(m.rotation.T @ self._newest[:3, :3].T @ odom_T_imu[:3, :3])
        jacobian = m.rotation_by_gyro
        noise = 2 * ROTATION_SIGMA**2 + float(m.covariance[0, 0])
        gain = p @ jacobian.T @ np.linalg.inv(jacobian @ p @ jacobian.T + noise * np.eye(3))
        self._bias = self._bias + gain @ (seen - jacobian @ (self._bias - m.gyro_bias))
        p = p - gain @ jacobian @ p
        self._bias_p = 0.5 * (p + p.T)

    def gyro_bias(self) -> F64:
        """(3,) rad/s: what makes the integrated rotations those of the poses."""
        return self._bias

    @property
    def gyro_bias_sigma(self) -> float:
        """rad/s, standard deviation of that."""
        return float(np.sqrt(np.trace(self._bias_p) / 3))

    def estimate(self) -> InertialState | None:
        """None before enough is seen."""
        if self._seconds < MIN_S:
            return None
        x, drift = self._x, self._newest[:3, :3].T @ self._x[9:12]
        variance = np.trace(self._bias_p) / 3 + np.trace(self._p[9:12, 9:12]) / 3
        return InertialState(
            velocity=x[:3].copy(),
            gravity=x[3:6].copy(),
            gyro_bias=self._bias + drift,
            accel_bias=x[6:9].copy(),
            covariance=self._p[:9, :9].copy(),
            gyro_bias_sigma=float(np.sqrt(variance)),
        )


def _link(m: Preintegrated, i: F64, j: F64, gyro_bias: F64) -> tuple[F64, F64, F64, F64]:
    """A motion between two poses (4, 4): move (3,) and i's integrated position and velocity (6,) with a gyroscope bias,
    derivatives of those by the accelerometer's bias (6, 3), covariance (6, 6)."""
    i_R_odom, t, zero = i[:3, :3].T, m.seconds, np.zeros(3)
    order = [3, 4, 5, 0, 1, 2]
    covariance = m.covariance[3:, 3:][np.ix_(order, order)].copy()
    covariance[:3, :3] += (POSITION_WALK**2 * t + POSITION_SIGMA_M**2) * np.eye(3)
    # A pose that is turned by an error turns the force with it.
    covariance[3:, 3:] += (ROTATION_SIGMA * GRAVITY * t) ** 2 * np.eye(3)
    moved = i_R_odom @ (j[:3, 3] - i[:3, 3])
    integrated = np.concatenate([m.position_with(gyro_bias, zero), m.velocity_with(gyro_bias, zero)])
    return moved, integrated, np.vstack([m.position_by_accel, m.velocity_by_accel]), covariance


@njit
def _advance(x, p, t, rotation, moved, integrated, by_bias, covariance, walk):
    """State (15,) and covariance (15, 15) at the next pose, and chi-squared of the move (3,) against what was expected.

    The noise of the integrated position is part of that of the integrated velocity: the gain contains both.
    """
    f, h, into = np.eye(15), np.zeros((3, 15)), np.zeros((15, 3))
    f[:3, 3:6] = t * np.eye(3)
    f[:3, 6:9] = rotation @ np.ascontiguousarray(by_bias[3:])
    g = x[3:6].copy()
    f[3, 10], f[3, 11], f[4, 9] = t * g[2], -t * g[1], -t * g[2]
    f[4, 11], f[5, 9], f[5, 10] = t * g[0], t * g[1], -t * g[0]
    keep = math.exp(-t / DRIFT_S)
    turned = np.ascontiguousarray(rotation.T)
    h[:, :3], h[:, 3:6], h[:, 6:9] = t * turned, 0.5 * t * t * turned, by_bias[:3]
    h[:, 12:] = -turned
    into[:3] = rotation
    expected = h @ x + integrated[:3]
    off = moved - expected
    ph = p @ h.T
    wv = into @ np.ascontiguousarray(covariance[3:, :3])
    s = h @ ph + covariance[:3, :3]
    for i in range(3):
        f[12 + i, 12 + i] = 0.0
        wv[12 + i] = POSITION_SIGMA_M**2 * rotation[i]
    chi2 = off @ np.linalg.solve(s, off)
    s *= max(chi2 / WRONG_CHI2, 1.0)
    x = f @ x
    x[:3] += rotation @ integrated[3:]
    p = f @ p @ f.T + into @ np.ascontiguousarray(covariance[3:, 3:]) @ into.T
    for i in range(3):
        p[9 + i] *= keep
        p[:, 9 + i] *= keep
        x[9 + i] *= keep
        p[6 + i, 6 + i] += walk
        p[12 + i, 12 + i] += POSITION_SIGMA_M**2
        p[9 + i, 9 + i] += (1.0 - keep * keep) * DRIFT_SIGMA**2
    m = f @ ph + wv
    for i in range(3):
        m[9 + i] *= keep
    gain = m @ np.linalg.inv(s)
    x = x + gain @ off
    x, p = _sized(x, p - gain @ s @ gain.T)
    return x, 0.5 * (p + p.T), chi2


@inner
def _sized(x, p):
    """Use the size of gravity, once its direction is known well enough to linearise it."""
    if p[3, 3] + p[4, 4] + p[5, 5] > KNOWN**2:
        return x, p
    size = math.sqrt((x[3:6] * x[3:6]).sum())
    along = np.ascontiguousarray(p[:, 3:6]) @ (x[3:6] / size)
    gain = along / ((along[3:6] * x[3:6]).sum() / size + GRAVITY_SIGMA**2)
    return x + gain * (GRAVITY - size), p - np.outer(gain, along)
