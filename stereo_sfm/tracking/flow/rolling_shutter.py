"""Rows exposed one after the other: each sees the world from where the camera was at its own time.

An image's stamp is the time of its middle row. The camera keeps one velocity while an image is read, so the row
`seconds` later saw from odom_T_cam @ exp(seconds * velocity) (Ait-Aider et al., ECCV 2006). Both eyes read the same row
at the same time. Rows alone determine the velocity badly: read in the same direction in every image, they let a scene
shrink along it unnoticed (Albl et al., Degeneracies in rolling shutter SfM, ECCV 2016). What holds it is the mean
velocity since the last frame, the more tightly the steadier the camera has moved of late.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.geometry.se3_kernels import exp_into
from stereo_sfm.types import F64, Corners

MEMORY_S = 1.0  # over which unsteadiness is averaged
UNSTEADY = 0.1  # m/s and rad/s between the means of successive frames, until it is known
LEAST_SIGMA = 0.005  # m/s and rad/s
LEAST_S = 1e-3  # between frames that say how steady the motion is


class RollingShutter:
    """The row times of one rig and how steadily it moves; with a global shutter nothing here changes anything."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._right_T_left = se3.inverse(rig.left_T_right)
        self._mean: F64 | None = None  # (6,) velocity between the last two frames
        self._unsteady = np.full(2, UNSTEADY**2)  # variance of its changes along one axis: linear, angular
        self.active = rig.readout_s > 0

    def learn(self, mean: F64, seconds: float) -> None:
        """Learn how steady the motion is from the mean velocity (6,) since the last frame, `seconds` before."""
        if not self.active or seconds < LEAST_S:  # such a mean is noise
            return
        if self._mean is not None:
            share = 1 - math.exp(-seconds / MEMORY_S)
            change = ((mean - self._mean) ** 2).reshape(2, 3).mean(1)
            self._unsteady += share * (change - self._unsteady)
        self._mean = mean

    def velocity_sigma(self) -> F64:
        """(6,) by how much the velocity at a frame differs from the mean since the last: half of what the means do."""
        return np.repeat(0.5 * np.sqrt(self._unsteady) + LEAST_SIGMA, 3)

    def row_seconds(self, uv: F64) -> F64:
        """(N,) seconds from the stamp to the exposure of the rows of pixels (N, 2); (0,) with a global shutter."""
        if not self.active:
            return np.zeros(0)
        return self._rig.row_seconds(uv[:, 1])

    def rays(self, odom_T_cam: F64, velocity: F64, uv: F64, bearing: F64) -> tuple[F64, F64]:
        """Origins (N, 3) and directions (N, 3) in the odometry frame of what pixels (N, 2) see, bearings (N, 3)."""
        if not self.active:
            return np.tile(odom_T_cam[:3, 3], (len(uv), 1)), bearing @ odom_T_cam[:3, :3].T
        seconds = self.row_seconds(uv)
        origin, tip = (_by_rows(p, velocity, seconds) for p in (np.zeros_like(bearing), bearing))
        return se3.transform(odom_T_cam, origin), (tip - origin) @ odom_T_cam[:3, :3].T

    def project(self, odom_T_cam: F64, velocity: F64, points: F64, uv: F64) -> F64:
        """Pixels (N, 2) where the left eye sees points (N, 3) of the odometry frame, NaN where it does not.

        Args:
            odom_T_cam, velocity: (4, 4) and (6,) at the stamp. uv: (N, 2) px, about where they are expected.
        """
        camera, points_cam = self._rig.left, se3.transform(se3.inverse(odom_T_cam), points)
        seen = camera.project(points_cam)
        if self.active:
            for _ in range(2):  # the row decides when a point is seen, and that on which row
                rows = np.where(np.isfinite(seen), seen, uv)
                seen = camera.project(_by_rows(points_cam, velocity, -self.row_seconds(rows)))
        return seen

    def at_stamp(self, uv_left: F64, uv_right: F64, points_cam: F64, velocity: F64) -> tuple[F64, F64]:
        """Pixels (N, 2) of both eyes as a global shutter would have seen them at the stamp.

        Args:
            uv_left, uv_right: as they were seen, NaN where they were not. points_cam: (N, 3) metres in the camera at
                the stamp. velocity: (6,) a second.
        """
        if not self.active:
            return uv_left, uv_right
        before = _by_rows(points_cam, velocity, -self.row_seconds(uv_left))
        return self._shifted(uv_left, uv_right, before, points_cam)

    def corners_at_stamp(self, corners: Corners, velocity: F64) -> Corners:
        """Corners, whose points are where their rows saw them, as a global shutter would have seen them."""
        if not self.active:
            return corners
        before = corners.points_cam.astype(np.float64)
        uv_left, uv_right = corners.uv_left.astype(np.float64), corners.uv_right.astype(np.float64)
        after = _by_rows(before, velocity, self.row_seconds(uv_left))
        columns = (*self._shifted(uv_left, uv_right, before, after), after)
        left, right, points = (column.astype(np.float32) for column in columns)
        return replace(corners, uv_left=left, uv_right=right, points_cam=points)

    def _shifted(self, uv_left: F64, uv_right: F64, before: F64, after: F64) -> tuple[F64, F64]:
        """Pixels of both eyes after points (N, 3) metres in the left camera have moved."""
        shifts: list[F64] = []
        for camera, eye_T_left in ((self._rig.left, np.eye(4)), (self._rig.right, self._right_T_left)):
            if camera is None:
                shifts.append(np.zeros((len(before), 2)))
                continue
            shift = camera.project(se3.transform(eye_T_left, after)) - camera.project(se3.transform(eye_T_left, before))
            shifts.append(np.where(np.isfinite(shift), shift, 0.0))
        return uv_left + shifts[0], uv_right + shifts[1]


@njit
def _by_rows(points, velocity, seconds):
    """Points (N, 3), each moved by exp(its seconds (N,) * velocity (6,))."""
    out, move = np.empty_like(points), np.zeros((4, 4))
    for k in range(len(points)):
        exp_into(velocity, seconds[k], move)
        for i in range(3):
            out[k, i] = move[i, 0] * points[k, 0] + move[i, 1] * points[k, 1] + move[i, 2] * points[k, 2] + move[i, 3]
    return out
