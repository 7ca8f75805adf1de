"""Prediction of the pose during a loss of tracking, from the motion of the last good second.

The covariance grows with the possible accelerations and turns of a robot.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

WINDOW_S = 1.0  # of motion whose mean is the velocity
FADE_S, TURN_FADE_S = 4.0, 1.0  # time constants with which the predicted speed and turn rate decrease
ACCELERATION = 0.5  # m/s^2, standard deviation of a robot's acceleration
MAX_SPEED_CHANGE = 0.5  # m/s
TURN_ACCELERATION = 1.0  # rad/s^2, standard deviation
MAX_TURN_RATE_CHANGE = 0.7  # rad/s
MAX_TURN_RATE, TURN_STEP = 1.0, np.deg2rad(20.0)  # rad/s, radians: turns that are tried
STEADY_SPEED, STEADY_TURN_RATE = 0.05, 0.05  # m/s, rad/s, standard deviations of a motion that goes on as before
SLOWER = 0.5, 0.0  # shares of the last speed that are tried
UNKNOWN_SPEED, UNKNOWN_TURN_RATE = 1.0, 0.5  # m/s, rad/s, standard deviations before any motion was seen
FIRST_SIGMAS = (0.01, 0.005)  # metres, radians: of the last trusted pose and its velocity


@dataclass(frozen=True, eq=False)
class Expectation:
    """A predicted pose with its uncertainty."""

    odom_T_cam: F64  # (4, 4)
    sigma_m: float  # of the position, along every axis
    sigma_rad: float  # of the rotation, about every axis

    @staticmethod
    def of(odom_T_cam: F64, covariance: F64) -> Expectation:
        """A pose (4, 4) with the covariance (6, 6) of pose @ exp(xi)."""
        metres, radians = (math.sqrt(np.trace(covariance[k : k + 3, k : k + 3]) / 3) for k in (0, 3))
        return Expectation(odom_T_cam, FIRST_SIGMAS[0] + metres, FIRST_SIGMAS[1] + radians)

    @property
    def covariance(self) -> F64:
        """(6, 6) of odom_T_cam @ exp(xi)."""
        return np.diag(np.repeat(np.square([self.sigma_m, self.sigma_rad]), 3))

    def sigmas_off(self, pose: F64) -> float:
        """Difference of a pose (4, 4) in standard deviations, the larger of position and rotation."""
        metres, radians = se3.extent(se3.inverse(self.odom_T_cam) @ pose)
        return max(float(metres) / self.sigma_m, float(radians) / self.sigma_rad)


class MotionPrior:
    """The trusted poses of the last second."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, F64]] = deque()

    def add(self, stamp_ns: int, odom_T_cam: F64) -> None:
        """Add the pose of a frame that most points agree with."""
        self._poses.append((stamp_ns, odom_T_cam))
        while stamp_ns - self._poses[1 if len(self._poses) > 1 else 0][0] > WINDOW_S * 1e9:
            self._poses.popleft()

    def forget(self) -> None:
        """Discard all poses: a new odometry begins."""
        self._poses.clear()

    def velocity(self) -> F64:
        """(6,) mean tangent a second; zero before there is motion."""
        (first_ns, first), (last_ns, last) = self._poses[0], self._poses[-1]
        if first_ns == last_ns:
            return np.zeros(6)
        return np.asarray(se3.log(se3.inverse(first) @ last)) / ((last_ns - first_ns) * 1e-9)

    def velocity_at(self, stamp_ns: int) -> F64:
        """(6,) the velocity at a later time: the last one, decreased exponentially."""
        seconds = max((stamp_ns - self._poses[-1][0]) * 1e-9, 0.0)
        return self.velocity() * np.exp(-seconds / np.repeat([FADE_S, TURN_FADE_S], 3))

    def expect(self, stamp_ns: int) -> Expectation:
        """The predicted pose at a time, with the last speed and turn rate decreasing exponentially."""
        last_ns, last = self._poses[-1]
        seconds = max((stamp_ns - last_ns) * 1e-9, 0.0)
        moved = self.velocity()
        moved[:3] *= _faded(seconds, FADE_S)
        moved[3:] *= _faded(seconds, TURN_FADE_S)
        metres = min(0.5 * ACCELERATION * seconds, MAX_SPEED_CHANGE) * seconds
        radians = min(0.5 * TURN_ACCELERATION * seconds, MAX_TURN_RATE_CHANGE) * seconds
        if self._poses[0][0] == last_ns:
            metres, radians = metres + UNKNOWN_SPEED * seconds, radians + UNKNOWN_TURN_RATE * seconds
        return Expectation(last @ se3.exp(moved), FIRST_SIGMAS[0] + metres, FIRST_SIGMAS[1] + radians)

    def steady(self, stamp_ns: int) -> Expectation:
        """The pose at a time if the robot goes on straight at its speed, which most do most of the time."""
        last_ns, last = self._poses[-1]
        seconds = max((stamp_ns - last_ns) * 1e-9, 0.0)
        forward = self.velocity() * ([1.0] * 3 + [0.0] * 3) * seconds
        sigmas = FIRST_SIGMAS[0] + STEADY_SPEED * seconds, FIRST_SIGMAS[1] + STEADY_TURN_RATE * seconds
        return Expectation(last @ se3.exp(forward), *sigmas)

    def others(self, stamp_ns: int) -> list[F64]:
        """Poses (4, 4) at a time after other motions that a robot is capable of, on arcs; the straight one first.

        All of them begin at the last speed, which decreases exponentially.

        The camera is taken to be upright: a robot turns about its y axis.
        """
        last_ns, last = self._poses[-1]
        seconds = max((stamp_ns - last_ns) * 1e-9, 0.0)
        fade = _faded(seconds, FADE_S)
        forward = self.velocity() * ([1.0] * 3 + [0.0] * 3) * fade
        turns = np.arange(TURN_STEP, min(MAX_TURN_RATE * seconds, math.pi) + 0.5 * TURN_STEP, TURN_STEP)
        arcs = [(1.0, side * turn) for turn in turns.tolist() for side in (1.0, -1.0)]
        motions = [(1.0, 0.0), *((speed, 0.0) for speed in SLOWER), *arcs]
        return [last @ se3.exp(speed * forward + [0, 0, 0, 0, turn, 0]) for speed, turn in motions]


def _faded(seconds: float, constant: float) -> float:
    """Seconds at the first velocity that move as far as these at one that decreases exponentially."""
    return -constant * math.expm1(-seconds / constant)
