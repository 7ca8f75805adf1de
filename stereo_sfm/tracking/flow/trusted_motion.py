"""Where a camera that sees nothing is expected: from the last second of motion that could be trusted.

The covariance grows by what a robot can do in the meantime: brake, speed up, turn.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

WINDOW_S = 1.0  # of motion that the velocity is the mean of
FADE_S = 4.0  # in which a robot that sees nothing slows down to a third
ACCELERATION = 1.0  # m/s^2, standard deviation of what a robot may do
MOST_SPEED = 1.0  # m/s by which it then differs from before
TURNING = 1.0  # rad/s^2, likewise
MOST_TURN_RATE = 0.7  # rad/s, likewise
FIRST_SIGMAS = (0.01, 0.005)  # metres, radians: of the last trusted pose and its velocity


@dataclass(frozen=True, eq=False)
class Expectation:
    """Where a camera is, as far as its motion before tells."""

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
        """How far a pose (4, 4) is from here, in standard deviations of the worse of position and rotation."""
        metres, radians = se3.extent(se3.inverse(self.odom_T_cam) @ pose)
        return max(float(metres) / self.sigma_m, float(radians) / self.sigma_rad)


class TrustedMotion:
    """The poses of the last second that were beyond doubt."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, F64]] = deque()

    def add(self, stamp_ns: int, odom_T_cam: F64) -> None:
        """The pose of a frame that most of what was seen agrees with."""
        self._poses.append((stamp_ns, odom_T_cam))
        while stamp_ns - self._poses[1 if len(self._poses) > 1 else 0][0] > WINDOW_S * 1e9:
            self._poses.popleft()

    def forget(self) -> None:
        """What was before is another odometry."""
        self._poses.clear()

    def velocity(self) -> F64:
        """(6,) mean tangent a second; zero before there is motion."""
        (first_ns, first), (last_ns, last) = self._poses[0], self._poses[-1]
        if first_ns == last_ns:
            return np.zeros(6)
        return np.asarray(se3.log(se3.inverse(first) @ last)) / ((last_ns - first_ns) * 1e-9)

    def expect(self, stamp_ns: int) -> Expectation:
        """Where the camera is at a time, if it goes on more and more slowly as it went when it was last sure."""
        last_ns, last = self._poses[-1]
        seconds = max((stamp_ns - last_ns) * 1e-9, 0.0)
        moved = self.velocity() * FADE_S * -math.expm1(-seconds / FADE_S)
        metres = min(0.5 * ACCELERATION * seconds, MOST_SPEED) * seconds
        radians = min(0.5 * TURNING * seconds, MOST_TURN_RATE) * seconds
        return Expectation(last @ se3.exp(moved), FIRST_SIGMAS[0] + metres, FIRST_SIGMAS[1] + radians)
