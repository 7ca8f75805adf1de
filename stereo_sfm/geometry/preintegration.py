"""Preintegration of inertial samples into one relative motion, independent of the initial state.

Forster, Carlone, Dellaert, Scaramuzza: On-Manifold Preintegration for Real-Time Visual-Inertial Odometry, TRO 33, 2017;
equations 35 to 38 and the recursive forms of the appendix. Rates are constant over each interval, and forces act in the
axes at its middle: at 200 Hz and 1 rad/s the axes at its beginning would be off by a seventieth of a degree, 0.02 m/s^2
of gravity, always to the same side.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.kernels import inner, njit
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

    def then(self, following: Preintegrated) -> Preintegrated:
        """The motion over both intervals, the following one with the biases of this one, to first order."""
        r, v, p, t = self.rotation, self.velocity, self.position, following.seconds
        biases = self.gyro_bias, self.accel_bias
        turn, pushed = following.rotation_with(self.gyro_bias), following.velocity_with(*biases)
        moved = following.position_with(*biases)
        by_rotation = np.eye(9)  # the error at the end by that at the middle ...
        by_rotation[:3, :3] = turn.T
        by_rotation[3:6, :3], by_rotation[6:, :3] = -r @ se3.skew(pushed), -r @ se3.skew(moved)
        by_rotation[6:, 3:6] = t * np.eye(3)
        by_following = np.eye(9)  # ... and by that of the following motion
        by_following[3:6, 3:6] = by_following[6:, 6:] = r
        return Preintegrated(
            seconds=self.seconds + t,
            rotation=r @ turn,
            velocity=v + r @ pushed,
            position=p + v * t + r @ moved,
            gyro_bias=self.gyro_bias,
            accel_bias=self.accel_bias,
            rotation_by_gyro=turn.T @ self.rotation_by_gyro + following.rotation_by_gyro,
            velocity_by_gyro=self.velocity_by_gyro
            + by_rotation[3:6, :3] @ self.rotation_by_gyro
            + r @ following.velocity_by_gyro,
            velocity_by_accel=self.velocity_by_accel + r @ following.velocity_by_accel,
            position_by_gyro=self.position_by_gyro
            + self.velocity_by_gyro * t
            + by_rotation[6:, :3] @ self.rotation_by_gyro
            + r @ following.position_by_gyro,
            position_by_accel=self.position_by_accel + self.velocity_by_accel * t + r @ following.position_by_accel,
            covariance=by_rotation @ self.covariance @ by_rotation.T
            + by_following @ following.covariance @ by_following.T,
        )


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


@inner
def exp_and_jacobian(phi, rotation, jacobian):
    """Rotation of a tangent (3,) and its right Jacobian, into (3, 3) arrays."""
    x, y, z = phi[0], phi[1], phi[2]
    xx, yy, zz = x * x, y * y, z * z
    angle2 = xx + yy + zz
    angle = math.sqrt(angle2)
    if angle < 1e-5:
        a, b, c = 1.0 - angle2 / 6, 0.5 - angle2 / 24, 1.0 / 6 - angle2 / 120
    else:
        a, b = math.sin(angle) / angle, (1 - math.cos(angle)) / angle2
        c = (angle - math.sin(angle)) / (angle2 * angle)
    for out, by_k, by_kk in ((rotation, a, b), (jacobian, -b, c)):
        out[0, 0], out[0, 1], out[0, 2] = 1.0 - by_kk * (yy + zz), by_kk * x * y - by_k * z, by_kk * x * z + by_k * y
        out[1, 0], out[1, 1], out[1, 2] = by_kk * x * y + by_k * z, 1.0 - by_kk * (xx + zz), by_kk * y * z - by_k * x
        out[2, 0], out[2, 1], out[2, 2] = by_kk * x * z - by_k * y, by_kk * y * z + by_k * x, 1.0 - by_kk * (xx + yy)


@njit
def _product(a, b, out):
    """a @ b of (3, 3) matrices, into `out`: a library's product takes longer to begin than this to finish."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@inner
def _transported(step, covariance, half_way):
    """covariance (9, 9) becomes step @ covariance @ step.T, without the zeros of `step`."""
    for i in range(9):
        for j in range(9):
            s = covariance[i, j] if i >= 3 else 0.0
            for k in range(3):
                s += step[i, k] * covariance[k, j]
            if i >= 6:
                s += step[i, i - 3] * covariance[i - 3, j]
            half_way[i, j] = s
    for i in range(9):
        for j in range(9):
            s = half_way[i, j] if j >= 3 else 0.0
            for k in range(3):
                s += half_way[i, k] * step[j, k]
            if j >= 6:
                s += half_way[i, j - 3] * step[j, j - 3]
            covariance[i, j] = s


@njit
def _integrate(seconds, gyro, accel, gyro_bias, accel_bias, gyro_density2, accel_density2):
    rotation, velocity, position = np.eye(3), np.zeros(3), np.zeros(3)
    r_g, v_g, v_a = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    p_g, p_a, covariance = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((9, 9))
    turn, right, half, half_right = np.eye(3), np.eye(3), np.eye(3), np.eye(3)
    middle, turned_force, r_g_middle, by_gyro = np.eye(3), np.eye(3), np.eye(3), np.eye(3)
    phi, f, a, force = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    skew, product = np.zeros((3, 3)), np.zeros((3, 3))
    step, half_way = np.eye(9), np.zeros((9, 9))
    for k in range(len(seconds)):
        dt = seconds[k]
        if dt <= 0:
            continue
        for i in range(3):
            phi[i], f[i] = (gyro[k, i] - gyro_bias[i]) * dt, accel[k, i] - accel_bias[i]
        exp_and_jacobian(phi, turn, right)
        for i in range(3):
            phi[i] *= 0.5
        exp_and_jacobian(phi, half, half_right)
        for i in range(3):
            a[i] = half[i, 0] * f[0] + half[i, 1] * f[1] + half[i, 2] * f[2]
        for i in range(3):
            force[i] = rotation[i, 0] * a[0] + rotation[i, 1] * a[1] + rotation[i, 2] * a[2]
        _product(rotation, half, middle)
        _product(half, half_right, product)
        skew[0, 1], skew[0, 2], skew[1, 2] = -a[2], a[1], -a[0]
        skew[1, 0], skew[2, 0], skew[2, 1] = a[2], -a[1], a[0]
        _product(rotation, skew, turned_force)
        for i in range(3):
            for j in range(3):
                r_g_middle[i, j] = r_g[i, j] - product[i, j] * (0.5 * dt)
                step[i, j] = turn[j, i]
                step[3 + i, j] = -turned_force[i, j] * dt
                step[6 + i, j] = -0.5 * turned_force[i, j] * dt * dt
            step[6 + i, 3 + i] = dt
        _transported(step, covariance, half_way)
        for i in range(3):
            for j in range(3):
                s = right[i, 0] * right[j, 0] + right[i, 1] * right[j, 1] + right[i, 2] * right[j, 2]
                covariance[i, j] += s * (gyro_density2 * dt)
            covariance[3 + i, 3 + i] += accel_density2 * dt
            covariance[6 + i, 6 + i] += accel_density2 * dt * dt * dt / 3
            covariance[3 + i, 6 + i] += 0.5 * accel_density2 * dt * dt
            covariance[6 + i, 3 + i] += 0.5 * accel_density2 * dt * dt
        _product(turned_force, r_g_middle, by_gyro)
        for i in range(3):
            for j in range(3):
                p_a[i, j] += v_a[i, j] * dt - 0.5 * middle[i, j] * dt * dt
                p_g[i, j] += v_g[i, j] * dt - 0.5 * by_gyro[i, j] * dt * dt
                v_a[i, j] -= middle[i, j] * dt
                v_g[i, j] -= by_gyro[i, j] * dt
                product[i, j] = turn[j, i]
            position[i] += velocity[i] * dt + 0.5 * force[i] * dt * dt
            velocity[i] += force[i] * dt
        _product(product, r_g, by_gyro)
        _product(rotation, turn, product)
        for i in range(3):
            for j in range(3):
                r_g[i, j] = by_gyro[i, j] - right[i, j] * dt
                rotation[i, j] = product[i, j]
    return rotation, velocity, position, r_g, v_g, v_a, p_g, p_a, covariance
