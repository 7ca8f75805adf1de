"""Integration of measured velocities into one relative motion with covariance: wheels, turned by a gyroscope."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.geometry.preintegration import exp_and_jacobian
from stereo_sfm.types import F64


@dataclass(frozen=True, eq=False)
class TwistMotion:
    """Motion from time i to time j in the moving frame's axes at i."""

    seconds: float
    rotation: F64  # (3, 3) i_R_j
    position: F64  # (3,) m
    rotation_by_rate: F64  # (3, 3) derivative of the rotation's right tangent by a constant error of the rate
    position_by_rate: F64  # (3, 3) derivative of the position by that error
    covariance: F64  # (6, 6) of position (axes at i) and rotation (right tangent), by white noise alone
    way: float  # m along the path


def integrate_twists(seconds: F64, angular: F64, linear: F64, angular_noise: float, linear_noise: float) -> TwistMotion:
    """Integrate velocities that are constant over each interval; the linear one acts in the axes at its middle.

    Args:
        seconds: (N,) length of each interval. angular: (N, 3) rad/s. linear: (N, 3) m/s, both in the moving axes.
        angular_noise, linear_noise: densities, rad/s/sqrt(Hz) and m/s/sqrt(Hz).
    """
    parts = _integrate(
        np.ascontiguousarray(seconds), np.ascontiguousarray(angular), np.ascontiguousarray(linear), angular_noise**2,
        linear_noise**2,
    )  # fmt: skip
    rotation, position, by_rate, moved_by_rate, covariance = parts
    way = float((np.linalg.norm(linear, axis=1) * seconds).sum())
    return TwistMotion(float(seconds.sum()), rotation, position, by_rate, moved_by_rate, covariance, way)


@njit
def _integrate(seconds, angular, linear, angular_density2, linear_density2):
    rotation, position = np.eye(3), np.zeros(3)
    by_rate, moved_by_rate, covariance = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((6, 6))
    turn, right, half, half_right = np.eye(3), np.eye(3), np.eye(3), np.eye(3)
    step, noisy = np.eye(6), angular_density2 > 0.0 or linear_density2 > 0.0
    for k in range(len(seconds)):
        dt = seconds[k]
        if dt <= 0:
            continue
        exp_and_jacobian(angular[k] * dt, turn, right)
        exp_and_jacobian(angular[k] * (0.5 * dt), half, half_right)
        middle = rotation @ half
        v = linear[k]
        skew = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
        moved = middle @ skew
        by_rate_middle = half.T @ by_rate + half_right * (0.5 * dt)
        moved_by_rate -= moved @ by_rate_middle * dt
        if noisy:
            step[:3, 3:] = -moved @ half.T * dt
            step[3:, 3:] = turn.T
            covariance = step @ covariance @ step.T
            covariance[3:, 3:] += right @ right.T * (angular_density2 * dt)
            for i in range(3):
                covariance[i, i] += linear_density2 * dt
        by_rate = turn.T @ by_rate + right * dt
        position += middle @ v * dt
        rotation = rotation @ turn
    return rotation, position, by_rate, moved_by_rate, covariance
