"""Rolling shutter: rows are exposed one after the other, each from the camera's pose at its own time.

An image's stamp is the time of its middle row. The velocity is constant during the readout, so the pose of the row
`seconds` later is odom_T_cam @ exp(seconds * velocity) (Ait-Aider et al., ECCV 2006). Both cameras read the same row at
the same time. Rows alone determine the velocity badly: with the same readout direction in every image, a scene shrunk
along it fits as well (Albl et al., Degeneracies in rolling shutter SfM, ECCV 2016). The velocity is therefore
constrained by the mean velocity since the last frame, the more tightly the steadier the recent motion.
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

MEMORY_S = 1.0  # time constant of the average of velocity changes
FIRST_CHANGE = 0.1  # m/s and rad/s, initial value of that average
MIN_SIGMA = 0.005  # m/s and rad/s
MIN_INTERVAL_S = 1e-3  # between frames whose mean velocity is used


class RollingShutter:
    """The row times of one rig and the steadiness of its motion; the identity for a global shutter."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._right_T_left = se3.inverse(rig.left_T_right)
        self._mean: F64 | None = None  # (6,) velocity between the last two frames
        self._change = np.full(2, FIRST_CHANGE**2)  # variance of its changes along one axis: linear, angular

    @property
    def readout_s(self) -> float:
        """Of the rig as it is now known."""
        return self._rig.readout_s

    @property
    def active(self) -> bool:
        """Whether rows are exposed one after the other."""
        return self._rig.readout_s != 0

    def use(self, readout_s: float) -> None:
        """Use another readout, in seconds."""
        if readout_s != self._rig.readout_s:
            self._rig = replace(self._rig, readout_s=readout_s)

    def learn(self, mean: F64, seconds: float) -> None:
        """Update the steadiness with the mean velocity (6,) since the last frame, `seconds` before."""
        if not self.active or seconds < MIN_INTERVAL_S:  # such a mean is noise
            return
        if self._mean is not None:
            share = 1 - math.exp(-seconds / MEMORY_S)
            change = ((mean - self._mean) ** 2).reshape(2, 3).mean(1)
            self._change += share * (change - self._change)
        self._mean = mean

    def velocity_sigma(self) -> F64:
        """(6,) standard deviation of the velocity at a frame from the mean since the last: half that of the means."""
        return np.repeat(0.5 * np.sqrt(self._change) + MIN_SIGMA, 3)

    def row_seconds(self, uv: F64) -> F64:
        """(N,) seconds from the stamp to the exposure of the rows of pixels (N, 2); (0,) with a global shutter."""
        if not self.active:
            return np.zeros(0)
        return self._rig.row_seconds(uv[:, 1])

    def rays(self, odom_T_cam: F64, velocity: F64, uv: F64, bearing: F64) -> tuple[F64, F64]:
        """Origins (N, 3) and directions (N, 3) in the odometry frame of the rays of pixels (N, 2), bearings (N, 3)."""
        if not self.active:
            return np.tile(odom_T_cam[:3, 3], (len(uv), 1)), bearing @ odom_T_cam[:3, :3].T
        seconds = self.row_seconds(uv)
        origin, tip = (_by_rows(p, velocity, seconds) for p in (np.zeros_like(bearing), bearing))
        return se3.transform(odom_T_cam, origin), (tip - origin) @ odom_T_cam[:3, :3].T

    def project(self, odom_T_cam: F64, velocity: F64, points: F64, uv: F64) -> F64:
        """Pixels (N, 2) of points (N, 3) of the odometry frame in the left image, NaN where not visible.

        Args:
            odom_T_cam, velocity: (4, 4) and (6,) at the stamp. uv: (N, 2) px, their approximate pixels.
        """
        camera, points_cam = self._rig.left, se3.transform(se3.inverse(odom_T_cam), points)
        seen = camera.project(points_cam)
        if self.active:
            for _ in range(2):  # fixed point: the row determines the time, and the time the row
                rows = np.where(np.isfinite(seen), seen, uv)
                seen = camera.project(_by_rows(points_cam, velocity, -self.row_seconds(rows)))
        return seen

    def at_stamp(self, uv_left: F64, uv_right: F64, points_cam: F64, velocity: F64) -> tuple[F64, F64]:
        """Pixels (N, 2) of both images with a global shutter at the stamp.

        Args:
            uv_left, uv_right: as observed, NaN where not. points_cam: (N, 3) metres in the camera at the stamp.
            velocity: (6,) a second.
        """
        if not self.active:
            return uv_left, uv_right
        before = _by_rows(points_cam, velocity, -self.row_seconds(uv_left))
        return self._shifted(uv_left, uv_right, before, points_cam)

    def corners_at_stamp(self, corners: Corners, velocity: F64) -> Corners:
        """Corners with points in the cameras of their rows -> those of a global shutter at the stamp."""
        if not self.active:
            return corners
        before = corners.points_cam.astype(np.float64)
        uv_left, uv_right = corners.uv_left.astype(np.float64), corners.uv_right.astype(np.float64)
        after = _by_rows(before, velocity, self.row_seconds(uv_left))
        columns = (*self._shifted(uv_left, uv_right, before, after), after)
        left, right, points = (column.astype(np.float32) for column in columns)
        return replace(corners, uv_left=left, uv_right=right, points_cam=points)

    def _shifted(self, uv_left: F64, uv_right: F64, before: F64, after: F64) -> tuple[F64, F64]:
        """Pixels of both images after a motion of points (N, 3) metres in the left camera."""
        shifts: list[F64] = []
        for camera, cam_T_left in ((self._rig.left, np.eye(4)), (self._rig.right, self._right_T_left)):
            if camera is None:
                shifts.append(np.zeros((len(before), 2)))
                continue
            shift = camera.project(se3.transform(cam_T_left, after)) - camera.project(se3.transform(cam_T_left, before))
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
