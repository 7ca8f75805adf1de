"""The camera's factory calibration as a rig.

Wire: p_body = R p_sensor + t, rotation column-major, metres; body axes are x right, y up, z backward, camera axes
x right, y down, z forward.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.live.errors import DeviceFault
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.protocol import CameraIntrinsics, MotionIntrinsics
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import KannalaBrandt
from stereo_sfm.types import F64

_BASELINE_M = (0.060, 0.068)
_MAX_TILT_DEG = 2.0
MIN_DENSITY = 1e-6  # a camera without known variances states 0
_ROBOT_T_BODY = np.array([[0.0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # x forward, y left, z up


def camera_model(intrinsics: CameraIntrinsics) -> KannalaBrandt:
    """The camera model of one camera.

    Raises:
        DeviceFault: implausible for a T265.
    """
    i = intrinsics
    fine = (i.width, i.height) == (m.WIDTH, m.HEIGHT) and all(150 < f < 450 for f in (i.fx, i.fy))
    if not fine or abs(i.cx - m.WIDTH / 2) > 100 or abs(i.cy - m.HEIGHT / 2) > 100:
        raise DeviceFault(
            f"invalid factory calibration of the T265: {i.width}x{i.height}, focal length {i.fx:.1f} {i.fy:.1f}, "
            f"centre {i.cx:.1f} {i.cy:.1f}"
        )
    return KannalaBrandt(i.width, i.height, i.fx, i.fy, i.cx, i.cy, i.distortion)


def rig(
    left: CameraIntrinsics, right: CameraIntrinsics, body_T_left: F64, body_T_right: F64, name: str, serial: str
) -> Rig:
    """The stereo rig, checked: baseline 60 to 68 mm to the right, cameras parallel within 2 degrees.

    Its body is the camera's, in the axes of robots.

    Raises:
        DeviceFault: the extrinsics are not those of a T265.
    """
    left_T_right = se3.inverse(_rigid(body_T_left)) @ _rigid(body_T_right)
    baseline = left_T_right[:3, 3]
    tilt = float(np.degrees(np.linalg.norm(se3.so3_log(left_T_right[:3, :3]))))
    if not _BASELINE_M[0] <= baseline[0] <= _BASELINE_M[1] or np.linalg.norm(baseline[1:]) > 0.01:
        raise DeviceFault(f"invalid factory extrinsics of the T265: right camera at {np.round(baseline * 1e3, 1)} mm")
    if tilt > _MAX_TILT_DEG:
        raise DeviceFault(f"invalid factory extrinsics of the T265: cameras {tilt:.1f} degrees from parallel")
    robot_T_left = _ROBOT_T_BODY @ _rigid(body_T_left)
    return Rig(camera_model(left), camera_model(right), left_T_right, robot_T_left, name=name, serial=serial)


def imu(body_T_left: F64, body_T_gyro: F64, gyro: MotionIntrinsics, accel: MotionIntrinsics) -> Imu:
    """The IMU relative to the left camera; the camera defines corrected = scale @ raw + bias."""
    return Imu(
        left_T_imu=se3.inverse(_rigid(body_T_left)) @ _rigid(body_T_gyro),
        gyro_matrix=gyro.scale,
        gyro_bias=-gyro.bias,
        accel_matrix=accel.scale,
        accel_bias=-accel.bias,
        gyro_noise=_density(gyro.noise_variance, m.GYRO_HZ),
        accel_noise=_density(accel.noise_variance, m.ACCEL_HZ),
        rate_hz=m.GYRO_HZ,
    )


def _density(variance: F64, rate_hz: float) -> float:
    """Noise density from the variance (3,) of one sample."""
    return max(float(np.sqrt(variance.mean() / rate_hz)), MIN_DENSITY)


def _rigid(body_T_sensor: F64) -> F64:
    rotation = body_T_sensor[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise DeviceFault("invalid factory extrinsics of the T265: a rotation matrix is not orthonormal")
    return se3.orthonormalize(body_T_sensor)
