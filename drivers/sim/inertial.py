"""The simulated inertial sensor: exact angular rates and specific forces along a drive, with noise and biases.

The T265 (BMI055) reports its own noise: variances 5.15e-6 (rad/s)^2 of a gyroscope sample at 200 Hz, 6.7e-5 (m/s^2)^2
of an accelerometer sample at 62.5 Hz, 5e-7 and 1e-4 of the biases, taken as their drift in 100 s. The OAK's BMI270
has the noise densities of its data sheet, 0.007 degrees/s and 160 micro-g per root hertz. The sensors in the BNO086 of
other OAKs have 0.014 degrees/s and 150 micro-g per root hertz and 1 degree/s of offset; its firmware calibrates the
accelerometer to 0.3 m/s^2 (data sheet of the BNO08X).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.imu import Imu
from stereo_sfm.drivers.sim.drives import Drive
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, I64, ImuSamples

RATE_HZ = 200.0
PHASE = 0.3  # of a period: samples and images are not taken at the same times
_GRAVITY = np.array([0.0, 0.0, -9.80665])  # m/s^2, world
_STEP_S = 2e-3  # of the differences below, which err by less than 1e-9 of the fastest shake
_FIRST = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280]) / _STEP_S
_SECOND = np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560]) / _STEP_S**2
_AROUND: F64 = np.linspace(-4 * _STEP_S, 4 * _STEP_S, 9)


@dataclass(frozen=True)
class Grade:
    """Noise and errors of a sensor."""

    gyro_noise: float = 0.0  # rad/s/sqrt(Hz)
    accel_noise: float = 0.0  # m/s^2/sqrt(Hz)
    gyro_walk: float = 0.0  # rad/s^2/sqrt(Hz)
    accel_walk: float = 0.0  # m/s^3/sqrt(Hz)
    gyro_bias: float = 0.0  # rad/s, standard deviation when switched on; not in the calibration
    accel_bias: float = 0.0  # m/s^2, the same
    scale: float = 0.0  # standard deviation of scale and misalignment, which the calibration contains
    calibrated_bias: float = 0.0  # m/s^2 of the accelerometer, which the calibration contains


GRADES = {
    "ideal": Grade(),
    "t265": Grade(1.6e-4, 1.04e-3, 7e-5, 1e-3, 0.004, 0.03, scale=0.01, calibrated_bias=0.15),
    "oak": Grade(1.22e-4, 1.57e-3, 2e-5, 3e-4, 0.008, 0.08),
    "bno086": Grade(2.44e-4, 1.47e-3, 4e-5, 5e-4, 0.017, 0.15),
}
_MOUNTS = {  # left_R_imu up to a few degrees, and metres
    "ideal": (np.diag([-1.0, -1.0, 1.0]), (0.032, 0.004, -0.006)),
    "t265": (np.diag([-1.0, -1.0, 1.0]), (0.032, 0.004, -0.006)),
    "oak": (np.array([[0, 1.0, 0], [1.0, 0, 0], [0, 0, -1.0]]), (0.038, -0.011, -0.009)),
    "bno086": (np.array([[0, -1.0, 0], [-1.0, 0, 0], [0, 0, -1.0]]), (0.038, -0.011, -0.009)),
}


class InertialSensor:
    """Gyroscope and accelerometer at a fixed place of the camera. `imu` is their calibration."""

    def __init__(self, name: str, drive: Drive, rng: np.random.Generator, offset_s: float = 0.0) -> None:
        """`name` of GRADES; `offset_s`: its clock minus the camera's."""
        self._drive, grade = drive, GRADES[name]
        turn, place = _MOUNTS[name]
        left_T_imu = se3.from_rotation_translation(turn @ se3.so3_exp(np.array([0.02, -0.03, 0.015])), np.array(place))
        gyro_matrix, accel_matrix = (np.eye(3) + rng.normal(0, grade.scale, (3, 3)) for _ in range(2))
        default = Imu()  # its noise is used for the ideal sensor: a filter needs a positive one
        self.imu = Imu(
            left_T_imu=left_T_imu, gyro_matrix=gyro_matrix, accel_matrix=accel_matrix,
            accel_bias=rng.normal(0, grade.calibrated_bias, 3), gyro_noise=grade.gyro_noise or default.gyro_noise,
            accel_noise=grade.accel_noise or default.accel_noise, gyro_walk=grade.gyro_walk or default.gyro_walk,
            accel_walk=grade.accel_walk or default.accel_walk,
            gyro_bias_sigma=grade.gyro_bias or default.gyro_bias_sigma,
            accel_bias_sigma=grade.accel_bias or default.accel_bias_sigma, rate_hz=RATE_HZ, offset_s=offset_s,
        )  # fmt: skip
        self._gyro_error, self._accel_error = self._errors(grade, rng)

    def _errors(self, grade: Grade, rng: np.random.Generator) -> tuple[F64, F64]:
        """(N, 3) each: bias, its random walk and white noise of every sample."""
        shape = (int((self._drive.duration + 1) * RATE_HZ) + 1, 3)
        out: list[F64] = []
        for noise, wander, bias in (
            (grade.gyro_noise, grade.gyro_walk, grade.gyro_bias),
            (grade.accel_noise, grade.accel_walk, grade.accel_bias),
        ):
            drift = np.cumsum(rng.normal(0, wander / RATE_HZ**0.5, shape), axis=0)
            out.append(rng.normal(0, bias, 3) + drift + rng.normal(0, noise * RATE_HZ**0.5, shape))
        return out[0], out[1]

    def exact(self, seconds: F64) -> tuple[F64, F64]:
        """Angular velocity (N, 3) rad/s and specific force (N, 3) m/s^2 in the sensor's axes at times (N,) in seconds.

        world_T_imu is a rotation about the vertical and a translation on a spline, times how the robot stands on the
        floor and the vibration. Derivatives of the first are those of the spline; those of the others, a few sines and
        error functions, are differences of eighth order.
        """
        around = np.add.outer(seconds, _AROUND).ravel()
        robot_T_imu = self._drive.robot_T_cam @ self._drive.shake(around) @ self.imu.left_T_imu
        robot_T_imu = (self._drive.standing(around) @ robot_T_imu).reshape(-1, len(_AROUND), 4, 4)
        now = robot_T_imu[:, len(_AROUND) // 2]
        speed = np.einsum("k,nkij->nij", _FIRST, robot_T_imu)
        acceleration = np.einsum("k,nki->ni", _SECOND, robot_T_imu[..., :3, 3])
        (heading, rate, rate_change) = (self._drive.course(seconds, k)[:, 2, None] for k in range(3))
        up = np.array([0.0, 0.0, 1.0])
        place, drift = now[:, :3, 3], speed[:, :3, 3]
        turning = 2 * rate * np.cross(up, drift) + rate_change * np.cross(up, place)
        turning += rate**2 * np.cross(up, np.cross(up, place))
        world_R_robot = se3.so3_exp(heading * up)
        course = self._drive.course(seconds, 2) * [1, 1, 0]
        force = np.einsum("nji,nj->ni", world_R_robot, course - _GRAVITY) + acceleration + turning
        skew = np.einsum("nji,njk->nik", now[:, :3, :3], speed[:, :3, :3])
        gyro = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)
        gyro = gyro + np.einsum("nji,nj->ni", now[:, :3, :3], rate * up)
        return gyro, np.einsum("nji,nj->ni", now[:, :3, :3], force)

    def samples(self, begin: float, end: float, epoch_ns: int) -> ImuSamples:
        """Samples after `begin` until `end` (seconds of the drive, camera's clock)."""
        rows = np.arange(*(max(0, int(np.floor(t * RATE_HZ - PHASE + 1e-9)) + 1) for t in (begin, end)))
        seconds: F64 = np.asarray((rows + PHASE) / RATE_HZ, np.float64)
        gyro, accel = self.exact(seconds)
        imu = self.imu
        gyro = (gyro + self._gyro_error[rows] + imu.gyro_bias) @ np.linalg.inv(imu.gyro_matrix).T
        accel = (accel + self._accel_error[rows] + imu.accel_bias) @ np.linalg.inv(imu.accel_matrix).T
        stamp_ns: I64 = epoch_ns + np.round((seconds + imu.offset_s) * 1e9).astype(np.int64)
        return ImuSamples(stamp_ns, gyro.astype(np.float64), accel.astype(np.float64))
