"""Smoothing of poses from the IMU alone, by the images before and after such an interval.

From the last good pose on, an error of the velocity grows with time and one of the acceleration (gravity's direction,
bias) with its square; position and velocity where the images come back determine both. Wheels correct the position
now and then: the velocity of such poses says nothing, and contradicts the rest.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, I64, Bool

VELOCITY_S = 0.2  # over which the velocity is measured where the images come back
# Standard deviations: m/s and m/s^2 of the errors that are expected, m and m/s where the images come back.
SIGMAS = np.array([0.008, 0.03, 0.002, 0.02])
SPEED_CHI2 = 16.8  # of six: beyond (1 % of right ones) the velocity is left out


def smooth_bridges(stamp_ns: I64, poses: F64, inertial: Bool) -> F64:
    """World poses (N, 4, 4) with every stretch of `inertial` rows (N,) brought to both of its ends.

    Stretches that have no good pose on one side stay as they are.
    """
    out = poses.copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inertial, [False]]).astype(np.int8)))
    for first, end in edges.reshape(-1, 2).tolist():
        if first > 0 and end < len(poses):
            out[first:end] = _corrected(stamp_ns, poses, first, end)
    return out


def _corrected(stamp_ns: I64, poses: F64, first: int, end: int) -> F64:
    """Rows first to end - 1, between the good poses first - 1 and end."""
    start = stamp_ns[first - 1]
    seconds = (stamp_ns - start) * 1e-9
    length = float(seconds[end])
    bridge = np.arange(max(first - 1, end - 3), end)
    predicted, speed = _at(seconds[bridge], poses[bridge, :3, 3], length)
    after = np.flatnonzero((np.arange(len(poses)) >= end) & (seconds < length + VELOCITY_S))
    error = poses[end, :3, 3] - predicted
    error_speed = _at(seconds[after], poses[after, :3, 3], length)[1] - speed
    # Rows: expected velocity and acceleration error, position and velocity error at the end.
    rows = np.array([[1.0, 0.0], [0.0, 1.0], [length, 0.5 * length**2], [1.0, length]])
    enough = len(after) >= 3 and end - first >= 2
    sigmas = np.where([True, True, True, enough], SIGMAS, np.inf)[:, None]
    seen = np.stack([np.zeros(3), np.zeros(3), error, error_speed])
    found, chi2, *_ = np.linalg.lstsq(rows / sigmas, seen / sigmas)
    if enough and chi2.sum() > SPEED_CHI2:
        found = np.linalg.lstsq(rows[:3] / sigmas[:3], seen[:3] / sigmas[:3])[0]
    velocity, acceleration = found
    t = seconds[first:end, None]
    out = poses[first:end].copy()
    out[:, :3, 3] += velocity * t + 0.5 * acceleration * t * t
    turn = _turn_error(seconds, poses, end)
    for row, share in zip(out, t[:, 0] / length, strict=True):
        row[:3, :3] = row[:3, :3] @ se3.so3_exp(share * turn)
    return out


def _at(seconds: F64, positions: F64, when: float) -> tuple[F64, F64]:
    """Position and velocity at a time, of the parabola (or line) nearest to some positions."""
    degree = min(len(seconds) - 1, 2)
    if degree < 1:
        return positions[0], np.zeros(3)
    t = seconds - when
    coefficients = np.linalg.lstsq(np.stack([t**k for k in range(degree + 1)], axis=1), positions)[0]
    return coefficients[0], coefficients[1]


def _turn_error(seconds: F64, poses: F64, end: int) -> F64:
    """(3,) rad between the rotation that goes on as before and the good one at row `end`."""
    before, last = poses[end - 2, :3, :3], poses[end - 1, :3, :3]
    rate = (seconds[end] - seconds[end - 1]) / (seconds[end - 1] - seconds[end - 2])
    predicted = last @ se3.so3_exp(rate * se3.so3_log(before.T @ last))
    return se3.so3_log(predicted.T @ poses[end, :3, :3])
