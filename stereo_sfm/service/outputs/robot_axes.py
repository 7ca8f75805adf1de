"""Poses in the axes that robots use (REP 103: x forward, y left, z up) instead of the left camera's.

The robot's frame is the calibration's body (`rig.body_T_left`), or the left camera turned so that x points forward
where the calibration has none. `map` and `odom` get the same axes, so that both begin with the robot at their origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.service.messages import PoseUpdate
from stereo_sfm.types import F64


@dataclass(frozen=True, eq=False)
class RobotPose:
    """One pose of the robot.

    Attributes:
        map_T_odom, odom_T_base: (4, 4).
        covariance: (6, 6) of odom_T_base: position, then rotation about x y z of odom.
        twist: (6,) of the robot in its own axes, NaN where unknown; twist_covariance: (6, 6).
    """

    map_T_odom: F64
    odom_T_base: F64
    covariance: F64
    twist: F64
    twist_covariance: F64

    @property
    def map_T_base(self) -> F64:
        """(4, 4)."""
        return self.map_T_odom @ self.odom_T_base


class RobotAxes:
    """Converts poses and points of the service to the robot's axes, for one rig."""

    def __init__(self, rig: Rig) -> None:
        self.base_T_left: F64 = rig.base_T_left
        self._left_T_base = se3.inverse(self.base_T_left)
        base_T_body = self.base_T_left @ se3.inverse(rig.body_T_left)
        self._body_T_base = se3.inverse(base_T_body)
        self._world_turn = np.kron(np.eye(2), self.base_T_left[:3, :3])
        self._body_turn = np.kron(np.eye(2), base_T_body[:3, :3])

    def pose(self, update: PoseUpdate) -> RobotPose:
        """A pose with its covariance and twist."""
        world, body = self._world_turn, self._body_turn
        return RobotPose(
            self.base_T_left @ update.map_T_odom @ self._left_T_base,
            self.base_T_left @ update.odom_T_body @ self._body_T_base,
            world @ update.covariance @ world.T,
            body @ update.twist,
            body @ update.twist_covariance @ body.T,
        )

    def points(self, points: F64) -> F64:
        """(N, 3) points of the map in the robot's map axes."""
        return se3.transform(self.base_T_left, points)

    def cameras(self, map_T_cam: F64) -> F64:
        """(N, 4, 4) poses of the left camera in the map -> poses of the robot."""
        return self.base_T_left @ map_T_cam @ self._left_T_base

    def in_map(self, map_T_x: F64) -> F64:
        """(4, 4) pose of a frame with axes of its own (a floor plan) in the map -> in the robot's map axes."""
        return self.base_T_left @ map_T_x
