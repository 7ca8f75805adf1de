"""`Imu`: pose, scale, misalignment, bias and noise of the inertial sensor of a rig."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import F64, ReadOnly

MAX_OFFSET_S = 1.0
MOST = 1e9  # of any number, and of the inverse of a noise, in its unit: no sensor comes near
TURN_SHARE = 2e-3  # of a turn: error of a calibrated gyroscope's scale and axes


@dataclass(frozen=True, eq=False)
class Imu(ReadOnly):
    """A gyroscope and an accelerometer in one frame. Corrected samples are `matrix @ raw - bias`.

    The default noise is that of a consumer sensor.
    """

    left_T_imu: F64 = field(default_factory=lambda: np.eye(4))  # (4, 4)
    gyro_matrix: F64 = field(default_factory=lambda: np.eye(3))  # (3, 3) scale and misalignment
    gyro_bias: F64 = field(default_factory=lambda: np.zeros(3))  # (3,) rad/s
    accel_matrix: F64 = field(default_factory=lambda: np.eye(3))  # (3, 3)
    accel_bias: F64 = field(default_factory=lambda: np.zeros(3))  # (3,) m/s^2
    gyro_noise: float = 2e-4  # rad/s/sqrt(Hz)
    accel_noise: float = 3e-3  # m/s^2/sqrt(Hz)
    gyro_walk: float = 3e-5  # rad/s^2/sqrt(Hz), of the bias
    accel_walk: float = 3e-3  # m/s^3/sqrt(Hz)
    gyro_bias_sigma: float = 0.05  # rad/s, what the calibration leaves of the bias when the sensor is switched on
    accel_bias_sigma: float = 0.3  # m/s^2, the same
    rate_hz: float = 200.0
    offset_s: float = 0.0  # IMU stamp minus camera stamp of the same instant (Kalibr's timeshift_cam_imu)

    def __post_init__(self) -> None:
        rotation = self.left_T_imu[:3, :3]
        if self.left_T_imu.shape != (4, 4) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
            raise StereoSfmError("invalid calibration: the pose of the IMU is not rigid; check left_T_imu")
        arrays = (self.left_T_imu, self.gyro_matrix, self.gyro_bias, self.accel_matrix, self.accel_bias)
        for array in arrays:
            array.flags.writeable = False
        noise = (
            self.gyro_noise, self.accel_noise, self.gyro_walk, self.accel_walk, self.gyro_bias_sigma,
            self.accel_bias_sigma, self.rate_hz,
        )  # fmt: skip
        if not all((np.abs(a) <= MOST).all() for a in arrays) or not all(1 / MOST <= n <= MOST for n in noise):
            raise StereoSfmError("invalid calibration of the IMU: a number is out of range, or a noise is not positive")
        if not abs(self.offset_s) <= MAX_OFFSET_S:
            raise StereoSfmError(f"invalid calibration: time offset of {self.offset_s:g} s between camera and IMU")

    def seen_from(self, new_T_left: F64) -> Imu:
        """The same sensor relative to another left camera frame, (4, 4)."""
        return replace(self, left_T_imu=new_T_left @ self.left_T_imu)

    def in_axes(self, left_R_imu: F64) -> Imu:
        """The same sensor with samples that are corrected into axes of another rotation (3, 3)."""
        turn = left_R_imu.T @ self.left_T_imu[:3, :3]
        left_T_imu = self.left_T_imu.copy()
        left_T_imu[:3, :3] = left_R_imu
        return replace(
            self, left_T_imu=left_T_imu, gyro_matrix=turn @ self.gyro_matrix, gyro_bias=turn @ self.gyro_bias,
            accel_matrix=turn @ self.accel_matrix, accel_bias=turn @ self.accel_bias,
        )  # fmt: skip

    def correct(self, gyro: F64, accel: F64) -> tuple[F64, F64]:
        """Raw samples (N, 3) rad/s and (N, 3) m/s^2 without scale errors, misalignment and known bias."""
        return gyro @ self.gyro_matrix.T - self.gyro_bias, accel @ self.accel_matrix.T - self.accel_bias
