"""Preintegration of inertial samples into one relative motion, independent of the initial state.

Forster, Carlone, Dellaert, Scaramuzza: On-Manifold Preintegration for Real-Time Visual-Inertial Odometry, TRO 33, 2017;
equations 35 to 38 and the recursive forms of the appendix. Rates are constant over each interval, and forces act in the
axes at its middle: at 200 Hz and 1 rad/s the axes at its beginning would be off by a seventieth of a degree, 0.02 m/s^2
of gravity, always to the same side.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.types import F64

GRAVITY = 9.80665  # m/s^2


@dataclass(frozen=True, eq=False)
class Preintegrated:
    """Motion from time i to time j in the IMU's axes at i, without gravity and initial velocity."""

    seconds: float
    rotation: F64  # (3, 3) i_R_j
    velocity: F64  # (3,) m/s
    position: F64  # (3,) m
    gyro_bias: F64  # (3,) rad/s, subtracted from the samples
    accel_bias: F64  # (3,) m/s^2, subtracted from the samples
    rotation_by_gyro: F64  # (3, 3) derivative of the rotation's right tangent by the gyroscope bias
    velocity_by_gyro: F64  # (3, 3)
    velocity_by_accel: F64  # (3, 3)
    position_by_gyro: F64  # (3, 3)
    position_by_accel: F64  # (3, 3)
    covariance: F64  # (9, 9) of rotation (right tangent), velocity, position

    def rotation_with(self, gyro_bias: F64) -> F64:
        """(3, 3) i_R_j with another bias (3,), to first order (equation 44)."""
        return self.rotation @ se3.so3_exp(self.rotation_by_gyro @ (gyro_bias - self.gyro_bias))

    def velocity_with(self, gyro_bias: F64, accel_bias: F64) -> F64:
        """(3,) m/s with other biases."""
        gyro, accel = gyro_bias - self.gyro_bias, accel_bias - self.accel_bias
        return self.velocity + self.velocity_by_gyro @ gyro + self.velocity_by_accel @ accel

    def position_with(self, gyro_bias: F64, accel_bias: F64) -> F64:
        """(3,) m with other biases."""
        gyro, accel = gyro_bias - self.gyro_bias, accel_bias - self.accel_bias
        return self.position + self.position_by_gyro @ gyro + self.position_by_accel @ accel


def preintegrate(
    seconds: F64, gyro: F64, accel: F64, gyro_bias: F64, accel_bias: F64, gyro_noise: float, accel_noise: float
) -> Preintegrated:
    """Integrate samples.

    Args:
        seconds: (N,) length of each interval. gyro: (N, 3) rad/s. accel: (N, 3) m/s^2, specific force.
        gyro_bias, accel_bias: (3,) subtracted from the samples.
        gyro_noise, accel_noise: densities, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).
    """
    parts = _integrate(
        np.ascontiguousarray(seconds), np.ascontiguousarray(gyro), np.ascontiguousarray(accel),
        np.ascontiguousarray(gyro_bias), np.ascontiguousarray(accel_bias), gyro_noise**2, accel_noise**2,
    )  # fmt: skip
    rotation, velocity, position, r_g, v_g, v_a, p_g, p_a, covariance = parts
    return Preintegrated(
        float(seconds.sum()), rotation, velocity, position, gyro_bias, accel_bias, r_g, v_g, v_a, p_g, p_a, covariance
    )


@njit
def _exp_and_jacobian(phi, rotation, jacobian):
    """Rotation of a tangent (3,) and its right Jacobian, into (3, 3) arrays."""
    x, y, z = phi[0], phi[1], phi[2]
    angle2 = x * x + y * y + z * z
    angle = np.sqrt(angle2)
    if angle < 1e-5:
        a, b, c = 1.0 - angle2 / 6, 0.5 - angle2 / 24, 1.0 / 6 - angle2 / 120
    else:
        a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / angle2
        c = (angle - np.sin(angle)) / (angle2 * angle)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    kk = k @ k
    rotation[:] = np.eye(3) + a * k + b * kk
    jacobian[:] = np.eye(3) - b * k + c * kk


@njit
def _integrate(seconds, gyro, accel, gyro_bias, accel_bias, gyro_density2, accel_density2):
    rotation, velocity, position = np.eye(3), np.zeros(3), np.zeros(3)
    r_g, v_g, v_a = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    p_g, p_a, covariance = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((9, 9))
    turn, right, half, half_right = np.eye(3), np.eye(3), np.eye(3), np.eye(3)
    step = np.eye(9)
    for k in range(len(seconds)):
        dt = seconds[k]
        if dt <= 0:
            continue
        _exp_and_jacobian((gyro[k] - gyro_bias) * dt, turn, right)
        _exp_and_jacobian((gyro[k] - gyro_bias) * (0.5 * dt), half, half_right)
        a = half @ (accel[k] - accel_bias)
        middle, r_g_middle = rotation @ half, r_g - half @ half_right * (0.5 * dt)
        force = rotation @ a
        skew = np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
        turned_force = rotation @ skew
        step[:3, :3] = turn.T
        step[3:6, :3] = -turned_force * dt
        step[6:, :3] = -0.5 * turned_force * dt * dt
        step[6:, 3:6] = np.eye(3) * dt
        covariance = step @ covariance @ step.T
        covariance[:3, :3] += right @ right.T * (gyro_density2 * dt)
        for i in range(3):
            covariance[3 + i, 3 + i] += accel_density2 * dt
            covariance[6 + i, 6 + i] += 0.25 * accel_density2 * dt * dt * dt
            covariance[3 + i, 6 + i] += 0.5 * accel_density2 * dt * dt
            covariance[6 + i, 3 + i] += 0.5 * accel_density2 * dt * dt
        p_a += v_a * dt - 0.5 * middle * dt * dt
        p_g += v_g * dt - 0.5 * turned_force @ r_g_middle * dt * dt
        v_a -= middle * dt
        v_g -= turned_force @ r_g_middle * dt
        r_g = turn.T @ r_g - right * dt
        position += velocity * dt + 0.5 * force * dt * dt
        velocity += force * dt
        rotation = rotation @ turn
    return rotation, velocity, position, r_g, v_g, v_a, p_g, p_a, covariance
