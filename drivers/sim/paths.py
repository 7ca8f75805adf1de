"""Paths of a robot over the floor from trajectory files: where it was, which way it headed, and when."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np

from stereo_sfm.drivers.ground_truth import read_trajectory
from stereo_sfm.drivers.sim.drives import FORWARD
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.input_file import read_text
from stereo_sfm.types import F64, Trajectory

STEP_M = 0.1  # least distance between positions from which a direction is taken
LEVEL = 0.9  # cosine of a tilt
_SESSION = "seq:"  # begins a session in a file of OpenLORIS-Scene
_SPEED, _TURN = 0.8, 0.6  # m/s and rad/s from the end of one path to the start of the next


@dataclass(frozen=True, eq=False)
class RobotPath:
    """The course of a robot: z up, metres, radians."""

    seconds: F64  # (N,) from 0, ascending
    course: F64  # (N, 3) x, y, heading (unwrapped)

    @property
    def length(self) -> float:
        """Metres."""
        return float(np.linalg.norm(np.diff(self.course[:, :2], axis=0), axis=1).sum())

    def moved(self, angle: float, shift: F64) -> RobotPath:
        """Turned about the origin by `angle` (radians), then shifted by (2,) metres."""
        c, s = np.cos(angle), np.sin(angle)
        xy = self.course[:, :2] @ np.array([[c, s], [-s, c]]) + shift
        return RobotPath(self.seconds, np.column_stack([xy, self.course[:, 2] + angle]))


def read_paths(file: Path) -> list[RobotPath]:
    """The paths in a trajectory file: one, or the sessions of a file of OpenLORIS-Scene (`seq:` heads each).

    Raises:
        StereoSfmError: no such file, or not a trajectory.
    """
    file = file.expanduser()
    text = read_text(file) if file.is_file() else ""
    if _SESSION not in text:
        return [robot_path(read_trajectory(file))]
    return [_session(file, part) for part in text.split(_SESSION)[1:]]


def _session(file: Path, text: str) -> RobotPath:
    """Rows `seconds x y z qx qy qz qw` after a line with the session's name."""
    name, *lines = text.splitlines()
    rows = [line.split() for line in lines if line.strip()]
    try:
        begin = Decimal(rows[0][0])
        table: F64 = np.array([[float(Decimal(r[0]) - begin), *map(float, r[1:8])] for r in rows])
        rotation = se3.rotation_from_quaternion(table[:, 4:8])
    except (ValueError, ArithmeticError, IndexError) as error:
        raise StereoSfmError(f"{file}: session {name.strip()} is not rows of a time and a pose: {error}") from None
    stamp_ns = np.round(table[:, 0] * 1e9).astype(np.int64)
    return robot_path(Trajectory(stamp_ns, se3.from_rotation_translation(rotation, table[:, 1:4])))


def robot_path(trajectory: Trajectory) -> RobotPath:
    """The path over the floor of a robot (x ahead, z up) or of its forward-looking camera (z ahead, y down).

    Which of them the poses are, and whether the world's z points up or, as where a trajectory begins at a level camera,
    its y down, is found from the axis that stays upright. Without orientation the heading is the direction of travel.
    """
    poses, xyz = trajectory.poses, trajectory.poses[:, :3, 3]
    if not trajectory.oriented:
        return _path(trajectory, xyz, _direction(xyz))
    robot, camera, started = (float(np.median(v)) for v in (poses[:, 2, 2], -poses[:, 2, 1], poses[:, 1, 1]))
    if min(robot, started) > LEVEL:  # it never turns far: the vertical is the axis along which it does not move
        robot, started = (0.0, 1.0) if np.ptp(xyz[:, 1]) < np.ptp(xyz[:, 2]) else (1.0, 0.0)
    ahead = poses[:, :3, 0] if robot >= max(camera, started) else poses[:, :3, 2]
    if started > max(robot, camera):
        xyz, ahead = xyz @ FORWARD.T, ahead @ FORWARD.T
    return _path(trajectory, xyz, np.arctan2(ahead[:, 1], ahead[:, 0]))


def _path(trajectory: Trajectory, xyz: F64, heading: F64) -> RobotPath:
    seconds = (trajectory.stamp_ns - trajectory.stamp_ns[0]) * 1e-9
    return RobotPath(seconds, np.column_stack([xyz[:, :2], np.unwrap(heading)]))


def _direction(at: F64) -> F64:
    """(N,) radians of the direction of travel of positions (N, 3)."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(at[:, :2], axis=0), axis=1))])
    kept = np.unique(np.searchsorted(arc, np.arange(0.0, arc[-1], STEP_M)))
    if len(kept) < 2:
        return np.zeros(len(at))
    step = np.diff(at[kept, :2], axis=0)
    angle = np.arctan2(step[:, 1], step[:, 0])
    return angle[np.clip(np.searchsorted(kept, np.arange(len(at)), "right") - 1, 0, len(angle) - 1)]


def joined(paths: list[RobotPath]) -> RobotPath:
    """Paths one after the other; the robot drives straight from the end of each to the start of the next."""
    seconds, course = paths[0].seconds, paths[0].course
    for path in paths[1:]:
        turn = float(path.course[0, 2] - course[-1, 2])
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        way = float(np.linalg.norm(path.course[0, :2] - course[-1, :2]))
        pause = max(way / _SPEED, abs(turn) / _TURN, 0.5)
        new = path.course.copy()
        new[:, 2] += course[-1, 2] + turn - new[0, 2]
        seconds = np.concatenate([seconds, seconds[-1] + pause + path.seconds])
        course = np.concatenate([course, new])
    return RobotPath(seconds, course)


def with_spot_turns(route: F64, speed: float, rest_s: float) -> RobotPath:
    """Along a polyline (N, 2) at `speed` (m/s), turning on the spot at its corners, at rest for `rest_s` before and
    afterwards."""
    steps = np.diff(route, axis=0)
    legs: list[RobotPath] = []
    for start, end, step in zip(route[:-1], route[1:], steps, strict=True):
        drive_s, heading = float(np.linalg.norm(step)) / speed, np.arctan2(step[1], step[0])
        seconds = np.cumsum([0.0, rest_s, drive_s, rest_s])
        legs.append(RobotPath(seconds, np.column_stack([[start, start, end, end], np.full(4, heading)])))
    return joined(legs)
