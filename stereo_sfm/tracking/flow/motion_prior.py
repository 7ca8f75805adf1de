"""Prediction of the pose during a loss of tracking, from the motion of the last good second.

Speed and turn rate return to zero, driven by random accelerations (an Ornstein-Uhlenbeck process; Gardiner, Handbook of
Stochastic Methods, 1985, section 4.4.4): the mean of the pose and its covariance follow from the two spreads and times.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

WINDOW_S = 1.0  # of motion whose mean is the velocity
# Of a robot's speed and turn rate: seconds in which they return to zero, and root mean squares, m/s and rad/s. Robots
# in stores drive 0.3 to 1.2 m/s; a turn by 90 degrees takes 1.5 to 3 s.
RETURN_S, SPREAD = np.array([4.0, 1.0]), np.array([0.8, 0.7])
FIRST_SIGMAS = np.array([0.01, 0.005])  # metres, radians: of the last trusted pose and its velocity
STEADY = np.array([0.05, 0.05])  # m/s, rad/s, standard deviations of a motion that goes on as before
DRIFT = 0.003, 0.0003  # of scale and heading, of good tracking: metres and radians per metre of the path
TURN_STEP = np.deg2rad(20.0)  # radians between turns that are tried


@dataclass(frozen=True, eq=False)
class Expectation:
    """A predicted pose with its uncertainty."""

    odom_T_cam: F64  # (4, 4)
    sigma_m: float  # of the position, along every axis
    sigma_rad: float  # of the rotation, about every axis

    @staticmethod
    def of(odom_T_cam: F64, covariance: F64) -> Expectation:
        """A pose (4, 4) with the covariance (6, 6) of pose @ exp(xi)."""
        return Expectation.around(odom_T_cam, np.sqrt(np.diag(covariance).reshape(2, 3).mean(1)))

    @staticmethod
    def around(odom_T_cam: F64, sigmas: F64) -> Expectation:
        """A pose (4, 4) with standard deviations (2,) metres and radians since the last trusted one."""
        metres, radians = FIRST_SIGMAS + sigmas
        return Expectation(odom_T_cam, float(metres), float(radians))

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
        self._trusted_ns = 0  # the newest pose that most points agree with

    def add(self, stamp_ns: int, odom_T_cam: F64, trusted: bool = True) -> None:
        """Add the pose of a frame. `trusted`: most points agree with it."""
        self._poses.append((stamp_ns, odom_T_cam))
        self._trusted_ns = stamp_ns if trusted else self._trusted_ns
        while stamp_ns - self._poses[1 if len(self._poses) > 1 else 0][0] > WINDOW_S * 1e9:
            self._poses.popleft()

    def forget(self) -> None:
        """Discard all poses: a new odometry begins."""
        self._poses.clear()

    def stale(self, stamp_ns: int) -> bool:
        """Whether no pose of the last second was trusted: any is better than one from before."""
        return self._seconds(stamp_ns) > WINDOW_S

    def velocity(self) -> F64:
        """(6,) mean tangent a second; zero before there is motion."""
        (first_ns, first), (last_ns, last) = self._poses[0], self._poses[-1]
        if first_ns == last_ns:
            return np.zeros(6)
        return np.asarray(se3.log(se3.inverse(first) @ last)) / ((last_ns - first_ns) * 1e-9)

    def velocity_at(self, stamp_ns: int) -> F64:
        """(6,) the velocity at a later time: the last one, decreased exponentially."""
        return self.velocity() * np.repeat(np.exp(-self._seconds(stamp_ns) / RETURN_S), 3)

    def expect(self, stamp_ns: int) -> Expectation:
        """The predicted pose at a time, with the last speed and turn rate decreasing exponentially."""
        (last_ns, last), periods = self._poses[-1], self._seconds(stamp_ns) / RETURN_S
        mean = last @ se3.exp(self.velocity() * np.repeat(RETURN_S * -np.expm1(-periods), 3))
        periods = max((stamp_ns - self._trusted_ns) * 1e-9, 0.0) / RETURN_S
        gone = -np.expm1(-periods)  # share of a speed that is gone
        known = 0.0 if self._poses[0][0] == last_ns else gone**2  # by the velocity, once there is motion
        speeds = np.linalg.norm(self.velocity().reshape(2, 3), axis=1)
        spread = np.maximum(SPREAD, speeds)  # who is faster is no such robot
        sigmas = spread * RETURN_S * np.sqrt(np.maximum(2 * (periods - gone) - known, 0.0))
        return Expectation.around(mean, sigmas)

    def steady(self, stamp_ns: int) -> Expectation:
        """The pose at a time if the robot goes on straight at its speed, which most do most of the time."""
        seconds = self._seconds(stamp_ns)
        return Expectation.around(self._poses[-1][1] @ se3.exp(self._forward() * seconds), STEADY * seconds)

    def others(self, stamp_ns: int) -> list[F64]:
        """Poses (4, 4) at a time after other motions that a robot is capable of, on arcs; the straight one first.

        All of them begin at the last speed, which decreases exponentially. The camera is taken to be
        upright: a robot turns about its y axis.
        """
        forward = self._forward() * RETURN_S[0] * -math.expm1(-self._seconds(stamp_ns) / RETURN_S[0])
        most = min(2.0 * self.expect(stamp_ns).sigma_rad, math.pi)  # turn that is tried, in both directions
        turns = np.arange(TURN_STEP, most + 0.5 * TURN_STEP, TURN_STEP)
        arcs = [(1.0, side * turn) for turn in turns.tolist() for side in (1.0, -1.0)]
        motions = [(1.0, 0.0), (0.5, 0.0), (0.0, 0.0), *arcs]  # shares of the last speed, turns
        return [self._poses[-1][1] @ se3.exp(speed * forward + [0, 0, 0, 0, turn, 0]) for speed, turn in motions]

    def _seconds(self, stamp_ns: int) -> float:
        """Since the last trusted pose."""
        return max((stamp_ns - self._poses[-1][0]) * 1e-9, 0.0)

    def _forward(self) -> F64:
        """(6,) the velocity without its turning."""
        return self.velocity() * ([1.0] * 3 + [0.0] * 3)
