"""How the camera is tilted on a robot that drives on a flat floor, measured while it drives.

There the camera turns about the vertical only and moves at right angles to it. In the camera's axes the vertical is the
direction that the rotations between keyframes share, and to which their translations and the lines between points of
the floor are perpendicular. A straight drive shows the pitch; turns and the floor show the roll, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.maps.floor import BELOW_M, THICK_M, floor_level
from stereo_sfm.types import F64, Keyframe

STEP_M, STEP_RAD = 0.5, 0.2  # metres, radians between keyframes that are compared: long against errors of millimetres
MIN_STEPS, MOST_STEPS = 10, 1000  # from which their scatter is known; that are kept
# Standard deviation of a roll about which nothing is known: cameras are mounted without measuring.
UPRIGHT_RAD = np.deg2rad(5.0)
ENOUGH_RAD = np.deg2rad(0.2)  # standard deviation of the pitch: 3 mm of height in a metre
# Between two estimates of one camera. Parts of four drives by car (KITTI, Karlsruhe) differ by 0.1 to 3.6, of 13 pairs
# one by 6; a camera that was moved by two degrees by 7 at least, for none is used above `ENOUGH_RAD`.
CHANGED_SIGMAS = 4.0
LEAST = np.array([1e-3, np.deg2rad(0.02), 1e-3]) ** 2  # variances (m^2, rad^2, m^2) below which no odometry is
FLOOR_RANGE_M = 5.0  # to points of the floor: farther ones are too uncertain for its level
POINTS = 200  # of a keyframe that are kept: 5 MB of a thousand keyframes
ROUNDS = 10  # of weights and direction, which depend on each other


@dataclass(frozen=True, eq=False)
class Mounting:
    """The vertical as the camera sees it."""

    up: F64  # (3,) unit vector in the left camera's axes
    pitch_sigma_deg: float  # standard deviation
    roll_sigma_deg: float

    @property
    def pitch_deg(self) -> float:
        """By which the camera looks down."""
        return -float(np.degrees(np.arcsin(self.up[2])))

    @property
    def roll_deg(self) -> float:
        """By which its right side hangs down."""
        return -float(np.degrees(np.arctan2(self.up[0], -self.up[1])))

    @property
    def measured(self) -> bool:
        """Whether the pitch is known well enough to be used."""
        return self.pitch_sigma_deg <= np.degrees(ENOUGH_RAD)

    def contradicts(self, other: Mounting) -> bool:
        """Whether the camera sits differently now: chance does not explain the difference."""
        pitch, roll = self.pitch_deg - other.pitch_deg, self.roll_deg - other.roll_deg
        return bool(
            abs(pitch) > CHANGED_SIGMAS * np.hypot(self.pitch_sigma_deg, other.pitch_sigma_deg)
            or abs(roll) > CHANGED_SIGMAS * np.hypot(self.roll_sigma_deg, other.roll_sigma_deg)
        )

    def surer(self, other: Mounting) -> bool:
        """Whether it is worth replacing the other: half its standard deviations."""
        sigmas = self.pitch_sigma_deg + self.roll_sigma_deg
        return sigmas < 0.5 * (other.pitch_sigma_deg + other.roll_sigma_deg)

    @property
    def text(self) -> str:
        """One line."""
        return (
            f"on a flat floor the camera looks down by {self.pitch_deg:.2f} ± {self.pitch_sigma_deg:.2f}°, "
            f"and its right side hangs down by {self.roll_deg:.2f} ± {self.roll_sigma_deg:.2f}°"
        )

    @property
    def body_T_left(self) -> F64:
        """(4, 4) the camera on a body with its origin in it: x ahead, y to the left, z up."""
        ahead = np.array([0.0, 0.0, 1.0]) - self.up[2] * self.up
        ahead /= np.linalg.norm(ahead)
        rotation: F64 = np.array([ahead, np.cross(self.up, ahead), self.up], np.float64)
        return se3.from_rotation_translation(rotation, np.zeros(3))


def unknown(rig: Rig) -> bool:
    """Whether nobody says how the camera is tilted: the calibration has no body, and no IMU feels gravity."""
    return rig.imu is None and np.allclose(rig.body_T_left, np.eye(4))


def mounted(rig: Rig, mounting: Mounting) -> Rig:
    """The calibration with the measured tilt."""
    return replace(rig, body_T_left=mounting.body_T_left)


class MountingEstimate:
    """Collects the keyframes of a drive, in order."""

    def __init__(self) -> None:
        self._before: Keyframe | None = None
        self._turns, self._moves = list[F64](), list[F64]()
        self._points: list[F64] = []

    @property
    def steps(self) -> int:
        """How many pairs of keyframes it has."""
        return len(self._moves)

    def add(self, keyframe: Keyframe) -> bool:
        """Take a keyframe; whether it says more than those before."""
        before = self._before
        if before is None or before.submap_id != keyframe.submap_id:
            self._before = keyframe
            return False
        step = se3.inverse(before.odom_T_cam) @ keyframe.odom_T_cam
        move, turn = step[:3, 3].copy(), se3.so3_log(step[:3, :3])
        if np.linalg.norm(move) < STEP_M and np.linalg.norm(turn) < STEP_RAD:
            return False
        self._before = keyframe
        if len(self._moves) >= MOST_STEPS:
            return False
        self._turns.append(turn)
        self._moves.append(move)
        near = keyframe.points_cam[np.linalg.norm(keyframe.points_cam, axis=1) < FLOOR_RANGE_M]  # False where NaN
        self._points.append(near[:: 1 + len(near) // POINTS].copy())
        return True

    def result(self) -> Mounting | None:
        """What the keyframes say; None before there are enough, or where the camera does not stand upright."""
        if len(self._moves) < MIN_STEPS:
            return None
        turns, moves = np.array(self._turns), np.array(self._moves)
        spread = np.stack([moves.T @ moves, np.eye(3) * (turns**2).sum() - turns.T @ turns, np.zeros((3, 3))])
        count = np.array([len(moves), 2 * len(turns), 0.0])
        up, hessian = np.array([0.0, -1.0, 0.0]), np.eye(3)
        right = np.array([1.0, 0.0, 0.0])
        for _ in range(ROUNDS):
            spread[2], count[2] = self._floor(up)
            variance = np.maximum(np.einsum("i,kij,j->k", up, spread, up) / np.maximum(count, 1), LEAST)
            hessian = (spread / variance[:, None, None]).sum(0) + np.outer(right, right) / UPRIGHT_RAD**2
            values, vectors = np.linalg.eigh(hessian)
            up = vectors[:, 0] * (-1.0 if vectors[1, 0] > 0 else 1.0)
            hessian -= values[0] * np.eye(3)
        if -up[1] < 0.5:  # tilted by more than 60 degrees: up and down may be confused
            return None
        ahead = np.cross(right, up) / np.linalg.norm(np.cross(right, up))
        across = np.stack([ahead, np.cross(up, ahead)])
        sigma = np.degrees(np.sqrt(np.diag(np.linalg.pinv(across @ hessian @ across.T))))
        return Mounting(up, float(sigma[0]), float(sigma[1]))

    def _floor(self, up: F64) -> tuple[F64, int]:
        """Mean squares (3, 3) of the floor points' offsets in each keyframe, summed; keyframes that see the floor."""
        depths = [-points @ up for points in self._points]
        every = np.concatenate(depths)
        below = every[every > BELOW_M]
        total, seen = np.zeros((3, 3)), 0
        if len(below) < MIN_STEPS:
            return total, seen
        level = floor_level(below)
        for points, depth in zip(self._points, depths, strict=True):
            chosen = points[np.abs(depth - level) < THICK_M]
            if len(chosen) > 2:
                offsets = chosen - chosen.mean(0)
                total, seen = total + offsets.T @ offsets / len(chosen), seen + 1
        return total, seen
