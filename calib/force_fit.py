"""What an accelerometer measured against how a camera moved: the rotation of an IMU about the vertical.

A robot turns about one axis, and its gyroscope hardly shows how it is turned about that axis itself. Its accelerations
do: starts, stops and curves push it horizontally.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.robust_fit import Whitening
from stereo_sfm.geometry.preintegration import GRAVITY
from stereo_sfm.types import F64

PARAMETERS = 6  # besides the rotation: the accelerometer's bias, the place of the IMU
ROTATION_WALK = 1e-4  # rad/sqrt(s) of the odometry: gravity moves with it
CONTROL = 4  # images in a third difference: it is zero for a constant acceleration


@dataclass(frozen=True, eq=False)
class Forces:
    """Third differences over successive images, in metres and the odometry's axes."""

    moved: F64  # (N - 3, 3) of the camera's positions
    turned: F64  # (N - 3, 3, 3) of its rotations
    pushed: F64  # (N - 3, 3, 3, 3) of odom_R_cam[:, i, j] f[k] integrated twice, forces f in the IMU's axes
    axes: F64  # (N - 3, 3, 3) of odom_R_cam integrated twice
    seconds: float  # between images

    @staticmethod
    def of(at: F64, poses: F64, times: F64, accel: F64) -> Forces | None:
        """None where the samples do not reach.

        Args:
            at: (N,) seconds of the images. poses: (N, 4, 4) odom_T_cam.
            times, accel: (M,) seconds on the same clock, (M, 3) m/s^2 of the samples.
        """
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        if len(times) < len(at) or times[0] > at[0] or times[-1] < at[-1]:
            return None
        turn = RotationSpline(at, Rotation.from_matrix(poses[:, :3, :3]))(np.clip(times, at[0], at[-1])).as_matrix()
        force = np.einsum("nij,nk->nijk", turn, accel)
        both = np.concatenate([force.reshape(-1, 27), turn.reshape(-1, 9)], axis=1)
        twice = np.asarray(CubicSpline(times, both).antiderivative(2)(at), np.float64)
        near = np.lib.stride_tricks.sliding_window_view(at, CONTROL)  # (N - 3, 4)
        seconds = float(np.median(np.diff(at)))
        apart = near[:, :, None] - near[:, None] + np.eye(CONTROL)
        weight = 6 * seconds**3 / apart.prod(axis=2)

        def third(values: F64) -> F64:
            rows = [weight[:, i].reshape(-1, *[1] * (values.ndim - 1)) * values[i : i - 3 or None] for i in range(4)]
            return np.sum(rows, axis=0)

        return Forces(
            third(poses[:, :3, 3]), third(poses[:, :3, :3]), third(twice[:, :27]).reshape(-1, 3, 3, 3),
            third(twice[:, 27:]).reshape(-1, 3, 3), seconds,
        )  # fmt: skip

    def residual(self, left_R_imu: F64, bias: F64, place: F64) -> F64:
        """(N - 3, 3) metres.

        Args:
            left_R_imu: (3, 3). bias: (3,) m/s^2, camera axes. place: (3,) m of the IMU in the camera.
        """
        return self.moved + self.turned @ place - np.einsum("nijk,jk->ni", self.pushed, left_R_imu) + self.axes @ bias

    def whitening(self, residual: F64, imu: Imu, rotation_sigma: float) -> Whitening:
        """What makes residuals independent: positions err by themselves, accelerations and gravity between them.

        An acceleration that is white noise acts on a third difference by the difference of two hat functions, one that
        walks by a quadratic B-spline.
        """
        t = self.seconds
        white = (imu.accel_noise**2 + (GRAVITY * rotation_sigma) ** 2 * t) * t**3
        walk = ((ROTATION_WALK * GRAVITY) ** 2 + imu.accel_walk**2) * t**5
        sensor = white * np.array([1, -1 / 3, -1 / 6, 0]) + walk * np.array([66, 26, 1, 0]) / 120
        variance = float(np.median(np.abs(residual)) * 1.4826) ** 2
        position = max(variance - sensor[0], 0.05 * variance) / 20
        return Whitening(sensor + position * np.array([20, -15, 6, -1]))
