"""Drives of the robot's camera through a store: smooth in position and direction, with the vibration of wheels.

A route is a polyline on the floor, driven at a varying speed and smoothed over time by a Gaussian, so that corners
become curves; position and heading are then cubic splines of time (twice continuously differentiable), and a few sines
with the frequencies of steps and wheels are added. The path of a real robot is smoothed in the same way. Thresholds and
ramps lift and tilt the robot, and somebody may push it by hand for a while: jerkily, sideways too, turning it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.special import erf

from stereo_sfm.drivers.sim.floor import Floor
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

FORWARD = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])  # world_R_cam of a camera that looks along x, upright
_RATE = 120.0  # samples a second of the dense route
_PATH_RATE = 40.0  # of a recorded path
_PUSHES = np.array([[0.02, 0.07, 0.10], [1.8, 0.45, 0.5]])  # by hand: metres ahead and to the left, radians; and Hz
_GRIP_S = 0.4  # in which a hand takes hold


@dataclass(frozen=True)
class Gait:
    """Motion and mounting of the camera."""

    speed: float = 0.95  # m/s
    height: float = 1.25  # metres above the floor
    pitch_deg: float = -4.0  # below the horizon is negative
    vibration: float = 1.0  # scale of the vibration
    turn_seconds: float = 0.65  # Gaussian width that rounds the corners
    rest_seconds: float = 1.0  # at rest before the drive
    ahead: float = 0.0  # metres from the robot's axle to the camera
    thresholds: int = 0  # that it drives over
    ramps: int = 0  # the same
    pushed: tuple[float, float] = (0.0, 0.0)  # seconds from, to: pushed by hand


class Drive:
    """world_T_cam at any time from 0 to `duration` seconds."""

    def __init__(self, route: F64, gait: Gait, rng: np.random.Generator, length: float) -> None:
        """`route`: (N, 2) metres, driven for `length` metres at most."""
        self.gait = gait
        t, arc = _progress(gait, rng, length, route)
        corners = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1))])
        sigma = gait.turn_seconds * _RATE
        xy = np.stack([np.interp(arc, corners, route[:, i]) for i in (0, 1)], -1)
        xy = gaussian_filter1d(xy, sigma, axis=0, mode="nearest")
        heading = gaussian_filter1d(_heading(xy, route), 0.4 * sigma, mode="nearest")
        self._follow(t, arc, np.column_stack([xy, heading]), rng)

    @classmethod
    def along(cls, seconds: F64, course: F64, gait: Gait, rng: np.random.Generator, length: float) -> Drive:
        """A drive along the recorded course of a robot: its times, its heading, its rests.

        Args:
            seconds: (N,) from 0, ascending. course: (N, 3) x, y (metres), heading (radians, unwrapped).
            gait: its speed 0 keeps the recorded times, another scales them all to that mean.
            length: metres driven at most; 0: all.
        """
        self = cls.__new__(cls)
        self.gait = gait
        driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(course[:, :2], axis=0), axis=1))])
        if gait.speed > 0 and driven[-1] > 0:
            seconds = seconds * (driven[-1] / gait.speed / seconds[-1])
        stop = float(np.interp(length, driven, seconds)) if 0 < length < driven[-1] else float(seconds[-1])
        t = np.arange(0, gait.rest_seconds + stop + 1 / _PATH_RATE, 1 / _PATH_RATE)
        sampled = np.column_stack([np.interp(t - gait.rest_seconds, seconds, course[:, i]) for i in range(3)])
        smooth = gaussian_filter1d(sampled, gait.turn_seconds * _PATH_RATE, axis=0, mode="nearest")
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth[:, :2], axis=0), axis=1))])
        self._follow(t, arc, smooth, rng)
        return self

    def _follow(self, t: F64, arc: F64, course: F64, rng: np.random.Generator) -> None:
        """Be at `course` (N, 3) after `arc` (N,) metres at the times (N,), and vibrate."""
        gait = self.gait
        self.duration = float(t[-1])
        self._times, self._arc = t, arc
        self._sines = _sines(rng, gait.vibration)
        self._metres = CubicSpline(t, arc)
        self.floor = Floor(gait.thresholds, gait.ramps, float(arc[-1]), rng) if gait.thresholds + gait.ramps else None
        if gait.pushed[1] > gait.pushed[0]:
            course = course + _pushes(t, course[:, 2], gait.pushed, rng)
        self._path = CubicSpline(t, course)

    def distance(self, seconds: float) -> float:
        """Metres along the route at which the camera is."""
        return float(np.interp(seconds, self._times, self._arc)) + self.gait.ahead

    def when(self, metres: float) -> float:
        """Seconds until the camera is so many metres along the route; the end of the drive if it is shorter."""
        return float(np.interp(metres - self.gait.ahead, self._arc, self._times))

    def place(self, metres: float, aside: float = 0.0) -> tuple[F64, float]:
        """Position (2,) and heading in radians after some metres of the route, `aside` metres to the left of it.

        Before its start and beyond its end the route is extended in a straight line.
        """
        x, y, heading = self._path(float(np.interp(metres, self._arc, self._times))).tolist()
        ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        beyond = metres - float(np.clip(metres, 0.0, self._arc[-1]))
        return np.array([x, y]) + beyond * ahead + aside * left, heading

    def poses(self, seconds: F64) -> F64:
        """Times (N,) -> world_T_cam (N, 4, 4): x right, y down, z forward."""
        seconds = np.asarray(seconds, float)
        return self.steady(seconds) @ self.shake(seconds)

    def shake(self, seconds: F64) -> F64:
        """Times (N,) -> vibration, steady_T_cam (N, 4, 4)."""
        amplitude, frequency, phase = self._sines
        return se3.exp((amplitude * np.sin(2 * np.pi * frequency * seconds[:, None, None] + phase)).sum(-1))

    def course(self, seconds: F64, derivative: int = 0) -> F64:
        """Times (N,) -> x, y (metres) and heading (rad) of the robot (N, 3), or their derivatives by time."""
        return np.asarray(self._path(seconds, derivative), float)

    def metres(self, seconds: F64, derivative: int = 0) -> F64:
        """Times (N,) -> metres driven (N,), or their derivatives by time."""
        return np.asarray(self._metres(seconds, derivative), float)

    def standing(self, seconds: F64) -> F64:
        """Times (N,) -> (N, 4, 4) from the robot on its thresholds and ramps to where it is on a flat floor."""
        if self.floor is None:
            return np.broadcast_to(np.eye(4), (len(seconds), 4, 4))
        return self.floor.standing(self.metres(seconds), self.gait.height)

    @property
    def robot_T_cam(self) -> F64:
        """(4, 4) from the camera without vibration to the robot's axes: x ahead, z up, at the camera's height."""
        rotation = FORWARD @ se3.so3_exp(np.array([np.deg2rad(self.gait.pitch_deg), 0, 0]))
        return se3.from_rotation_translation(rotation, np.array([self.gait.ahead, 0.0, 0.0]))

    def steady(self, seconds: F64) -> F64:
        """`poses` without vibration."""
        x, y, heading = self._path(seconds).T
        world_T_robot = se3.from_rotation_translation(
            se3.so3_exp(np.stack([0 * heading, 0 * heading, heading], -1)),
            np.stack([x, y, np.full_like(x, self.gait.height)], -1),
        )
        return world_T_robot @ self.standing(seconds) @ self.robot_T_cam


def _progress(gait: Gait, rng: np.random.Generator, length: float, route: F64) -> tuple[F64, F64]:
    """Times (N,) and metres driven (N,): at rest, a smooth start, then a speed that varies by a tenth."""
    length = min(length, float(np.linalg.norm(np.diff(route, axis=0), axis=1).sum()))
    t = np.arange(0, gait.rest_seconds + 1.4 * length / gait.speed + 3, 1 / _RATE)
    start = np.clip((t - gait.rest_seconds) / 1.5, 0, 1)
    phase = rng.uniform(0, 2 * np.pi, 2)
    speed = gait.speed * (1 + 0.08 * np.sin(0.9 * t + phase[0]) + 0.05 * np.sin(2.3 * t + phase[1]))
    speed *= start * start * (3 - 2 * start)
    arc = np.concatenate([[0.0], np.cumsum(speed[:-1]) / _RATE])
    n = int(np.searchsorted(arc, length)) + 1
    return t[:n], arc[:n]


def _pushes(t: F64, heading: F64, interval: tuple[float, float], rng: np.random.Generator) -> F64:
    """(N, 3) metres and radians that a hand adds to a course at the times (N,), robot axes turned by `heading` (N,)."""
    size, frequency = _PUSHES * rng.uniform(0.7, 1.3, (2, 3))
    held = 0.5 * (erf((t - interval[0]) / _GRIP_S) - erf((t - interval[1]) / _GRIP_S))
    ahead, left, turn = (held[:, None] * size * np.sin(2 * np.pi * frequency * t[:, None] + rng.uniform(0, 6.3, 3))).T
    c, s = np.cos(heading), np.sin(heading)
    return np.column_stack([c * ahead - s * left, s * ahead + c * left, turn])


def _heading(xy: F64, route: F64) -> F64:
    """(N,) radians of the direction of travel, unwrapped; constant while the robot is at rest."""
    velocity = np.gradient(xy, axis=0) * _RATE
    moving = np.linalg.norm(velocity, axis=1) > 0.02
    first = np.arctan2(*(route[1] - route[0])[::-1])
    angle = np.arctan2(velocity[:, 1], velocity[:, 0])
    index = np.maximum.accumulate(np.where(moving, np.arange(len(xy)), -1))
    return np.unwrap(np.where(index >= 0, angle[np.maximum(index, 0)], first))


def _sines(rng: np.random.Generator, scale: float) -> tuple[F64, F64, F64]:
    """Amplitudes, frequencies (Hz) and phases (6, K) of the vibration's tangent (metres, radians; camera axes)."""
    bands = ((0.9, 1.0), (1.8, 0.6), (3.1, 0.12), (6.7, 0.03))
    size = np.array([0.012, 0.009, 0.006, np.deg2rad(0.35), np.deg2rad(0.5), np.deg2rad(0.45)])
    amplitude = scale * size[:, None] * np.array([a for _, a in bands]) * rng.uniform(0.5, 1.0, (6, len(bands)))
    frequency = np.array([f for f, _ in bands]) * rng.uniform(0.9, 1.1, (6, len(bands)))
    return amplitude, frequency, rng.uniform(0, 2 * np.pi, (6, len(bands)))
