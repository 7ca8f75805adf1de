"""Velocity, gravity and biases from the poses of the last seconds and what the IMU measured between them.

Stereo knows the size of the motion, so that everything but the rotation is linear: the initialization of Qin and Shen
(Robust Initialization of Monocular Visual-Inertial Estimation, IROS 2017) without its scale, over a sliding window. The
rotation of the odometry drifts; what of it tilts gravity, the accelerometer shows, and the gyroscope's bias, which is
found from those rotations, is corrected by it. Velocities but the newest are eliminated one after the other: the cost
is that of one pass over the window.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.geometry.preintegration import GRAVITY, Preintegrated
from stereo_sfm.types import F64

MAX_SECONDS = 10.0  # of the window
MIN_S = 1.5  # of motion before velocity and gravity are used
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
        self._newest: F64 = np.eye(4)
        self._links: list[F64] = []  # one row (LINK,) a motion: see `_link`
        self._turns: list[tuple[F64, F64]] = []  # information (3, 3) and right-hand side (3,) of the gyroscope's bias

    @property
    def seconds(self) -> float:
        """How much time it covers."""
        return float(sum(link[0] for link in self._links))

    def begin(self, odom_T_imu: F64) -> None:
        """A first pose; nothing before it counts."""
        self._newest, self._links, self._turns = odom_T_imu, [], []

    def add(self, motion: Preintegrated, odom_T_imu: F64) -> None:
        """The next pose and the motion to it."""
        self._links.append(_link(motion, self._newest, odom_T_imu))
        self._turns.append(_turn(motion, self._newest, odom_T_imu))
        self._newest = odom_T_imu
        while self.seconds > MAX_SECONDS:
            del self._links[0], self._turns[0]

    def gyro_bias(self) -> tuple[F64, float]:
        """(3,) rad/s and its standard deviation: what makes the integrated rotations those of the poses."""
        information = np.eye(3) / GYRO_BIAS_SIGMA**2 + sum(i for i, _ in self._turns)
        covariance = np.linalg.inv(information).astype(np.float64)
        rhs = np.zeros(3) + sum(r for _, r in self._turns)
        return covariance @ rhs, float(np.sqrt(np.trace(covariance) / 3))

    def estimate(self) -> InertialState | None:
        """None while the window is too short."""
        if self.seconds < MIN_S:
            return None
        gyro_bias, gyro_sigma = self.gyro_bias()
        x, covariance = _solve(np.array(self._links), gyro_bias)
        gyro_bias = gyro_bias + self._newest[:3, :3].T @ x[9:]
        gyro_sigma = float(np.hypot(gyro_sigma, np.sqrt(np.trace(covariance[9:, 9:]) / 3)))
        return InertialState(
            velocity=x[:3].copy(),
            gravity=x[3:6].copy(),
            gyro_bias=gyro_bias,
            accel_bias=x[6:9].copy(),
            covariance=covariance[:9, :9].copy(),
            gyro_bias_sigma=gyro_sigma,
        )


def _turn(m: Preintegrated, i: F64, j: F64) -> tuple[F64, F64]:
    """What two poses (4, 4) say of the gyroscope's bias: information (3, 3) and right-hand side (3,)."""
    seen = se3.so3_log(m.rotation.T @ i[:3, :3].T @ j[:3, :3])
    jacobian = m.rotation_by_gyro
    weighted = jacobian.T / (2 * ROTATION_SIGMA**2 + float(m.covariance[0, 0]))
    return weighted @ jacobian, weighted @ (seen + jacobian @ m.gyro_bias)


def _link(m: Preintegrated, i: F64, j: F64) -> F64:
    """A motion between two poses (4, 4) as one row: seconds, i_R_odom, position and velocity (6,) without biases, their
    derivatives by the gyroscope's (6, 3) and the accelerometer's (6, 3) bias, weight (6, 6)."""
    i_R_odom, t, zero = i[:3, :3].T, m.seconds, np.zeros(3)
    covariance = m.covariance[3:, 3:][np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])].copy()
    covariance[:3, :3] += 2 * POSITION_SIGMA_M**2 * np.eye(3)
    # A pose that is turned by an error turns the force with it.
    covariance[3:, 3:] += (ROTATION_SIGMA * GRAVITY * t) ** 2 * np.eye(3)
    moved = i_R_odom @ (j[:3, 3] - i[:3, 3]) - m.position_with(zero, zero)
    by_gyro = np.vstack([-m.position_by_gyro, m.velocity_by_gyro])
    by_accel = np.vstack([m.position_by_accel, -m.velocity_by_accel])
    parts = (i_R_odom, moved, m.velocity_with(zero, zero), by_gyro, by_accel, np.linalg.inv(covariance))
    return np.concatenate([[t], *(part.ravel() for part in parts)])


@njit
def _solve(links, gyro_bias):
    """Newest velocity, gravity there, accelerometer bias, drift of the rotation (rad/s): (12,) and covariance."""
    total, gravity = 0.0, np.zeros(3)
    for k in range(len(links)):  # opposite to the mean specific force: right to the mean acceleration
        total += links[k, 0]
        gravity -= np.ascontiguousarray(links[k, 1:10]).reshape(3, 3).T @ links[k, 13:16]
    gravity /= total
    x, normal = np.zeros(12), np.zeros((12, 12))
    for _ in range(STEPS):  # the size of gravity is known: linearised along its direction, as is its drift
        normal, target = _normal_equations(links, gyro_bias, gravity, total)
        down = gravity / np.sqrt((gravity * gravity).sum())
        for a in range(3):
            target[3 + a] += down[a] * GRAVITY / GRAVITY_SIGMA**2
            for b in range(3):
                normal[3 + a, 3 + b] += down[a] * down[b] / GRAVITY_SIGMA**2
        x = np.linalg.solve(normal, target)
        gravity = x[3:6].copy()
    return x, np.linalg.inv(normal)


@njit
def _normal_equations(links, gyro_bias, gravity, total):
    """(12, 12) and (12,): each motion ties velocities i and j, gravity, bias and drift (15); i is then eliminated."""
    normal, rhs = np.zeros((12, 12)), np.zeros(12)
    for a in range(3):
        normal[6 + a, 6 + a] = 1.0 / ACCEL_BIAS_SIGMA**2
        normal[9 + a, 9 + a] = 1.0 / DRIFT_SIGMA**2
    skew = np.array([[0.0, -gravity[2], gravity[1]], [gravity[2], 0.0, -gravity[0]], [-gravity[1], gravity[0], 0.0]])
    since = -total  # from the newest pose
    jacobian, joint, joint_rhs = np.zeros((6, 15)), np.zeros((15, 15)), np.zeros(15)
    for k in range(len(links)):
        link, t = links[k], links[k, 0]
        i_R_odom = link[1:10].copy().reshape(3, 3)
        known = link[10:16] + link[16:34].copy().reshape(6, 3) @ gyro_bias
        weight = link[52:88].copy().reshape(6, 6)
        tilted = -i_R_odom @ skew * (since + 0.5 * t)  # of gravity by the drift until the newest pose
        since += t
        jacobian[:3, :3], jacobian[3:, :3], jacobian[3:, 3:6] = i_R_odom * t, -i_R_odom, i_R_odom
        jacobian[:3, 6:9], jacobian[3:, 6:9] = 0.5 * t * t * i_R_odom, -t * i_R_odom
        jacobian[:, 9:12] = link[34:52].copy().reshape(6, 3)
        jacobian[:3, 12:], jacobian[3:, 12:] = 0.5 * t * t * tilted, -t * tilted
        weighted = jacobian.T @ weight
        joint[:] = weighted @ jacobian
        joint_rhs[:] = weighted @ known
        joint[:3, :3] += normal[:3, :3]
        joint[:3, 6:] += normal[:3, 3:]
        joint[6:, :3] += normal[3:, :3]
        joint[6:, 6:] += normal[3:, 3:]
        joint_rhs[:3] += rhs[:3]
        joint_rhs[6:] += rhs[3:]
        out = joint[3:, :3].copy() @ np.linalg.inv(joint[:3, :3].copy())
        normal[:] = joint[3:, 3:] - out @ joint[:3, 3:].copy()
        rhs[:] = joint_rhs[3:] - out @ joint_rhs[:3]
    return normal, rhs
