"""The factory calibration of an OAK as this project's rig. depthai uses centimetres and p_dst = T p_src."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import brown
from stereo_sfm.calib.formats.depthai import imu_at
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.live.errors import DeviceFault
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt
from stereo_sfm.types import F64

_MAX_TILT_DEG = 5.0


def read_calibration(dai: Any, handler: Any, size: tuple[int, int], name: str, serial: str) -> Rig:
    """Calibration at an image size.

    Args:
        dai: the library. handler: its CalibrationHandler.
        size: (width, height) of the images, px; intrinsics are scaled and cropped to it.
        name, serial: for the rig.

    Raises:
        DeviceFault: not calibrated, an unknown lens model, or invalid extrinsics.
    """
    left, right = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
    try:
        cameras = [_camera(dai, handler, socket, size) for socket in (left, right)]
        left_T_right = _metres(handler.getCameraExtrinsics(right, left, False, dai.LengthUnit.CENTIMETER))
    except RuntimeError as error:
        raise DeviceFault(f"OAK {serial} is not calibrated ({str(error).splitlines()[0]})") from None
    _check(left_T_right, serial)
    left_T_imu = _imu(dai, handler, left)
    imu = None if left_T_imu is None else imu_at(left_T_imu, handler.eepromToJson().get("imuCalibrationParams"))
    return Rig(cameras[0], cameras[1], left_T_right, imu=imu, name=name, serial=serial)


def _camera(dai: Any, handler: Any, socket: Any, size: tuple[int, int]) -> Camera:
    matrix, width, height = handler.getDefaultIntrinsics(socket)
    fx, fy, cx, cy = _scaled(np.array(matrix, float), (int(width), int(height)), size)
    if not (fx > 0 and fy > 0 and 0 < cx < size[0] and 0 < cy < size[1]):
        raise DeviceFault(f"invalid factory calibration of the OAK: focal length {fx} {fy}, centre {cx} {cy}")
    model = handler.getDistortionModel(socket)
    coefficients = [float(c) for c in handler.getDistortionCoefficients(socket)]
    if model == dai.CameraModel.Fisheye:
        return KannalaBrandt(*size, fx, fy, cx, cy, tuple(coefficients[:4]))
    if model != dai.CameraModel.Perspective:
        raise DeviceFault(f"unsupported lens model {model} of the OAK: calibrate it with 'stereo-sfm calibrate'")
    try:
        return brown(size, (fx, fy), (cx, cy), coefficients)
    except ValueError as error:
        raise DeviceFault(f"invalid factory calibration of the OAK: {error}") from None


def _scaled(matrix: F64, at: tuple[int, int], size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Focal lengths and principal point after the camera has scaled its image to cover `size` and cropped it centrally.

    depthai's own getCameraIntrinsics pads where the camera crops, and ignores the half-pixel shift of pixel centres
    under binning.
    """
    if at[0] <= 0 or at[1] <= 0:
        raise DeviceFault("the OAK's factory calibration does not state its image size")
    s = max(size[0] / at[0], size[1] / at[1])
    cx, cy = ((matrix[k, 2] + 0.5) * s - 0.5 - (at[k] * s - size[k]) / 2 for k in (0, 1))
    return float(matrix[0, 0] * s), float(matrix[1, 1] * s), float(cx), float(cy)


def _metres(transform_cm: Any) -> F64:
    transform = np.array(transform_cm, float)
    transform[:3, 3] /= 100
    return se3.orthonormalize(transform)


def _check(left_T_right: F64, serial: str) -> None:
    baseline, tilt = left_T_right[:3, 3], float(np.degrees(np.linalg.norm(se3.so3_log(left_T_right[:3, :3]))))
    if not (0.01 <= baseline[0] <= 1.0 and np.linalg.norm(baseline[1:]) < 0.2 * baseline[0]) or tilt > _MAX_TILT_DEG:
        raise DeviceFault(
            f"OAK {serial}: invalid factory extrinsics, right camera at {np.round(baseline * 1e3, 1)} mm, "
            f"{tilt:.1f} degrees from parallel"
        )


def _imu(dai: Any, handler: Any, left: Any) -> F64 | None:
    """(4, 4) left_T_imu; unknown on many boards."""
    try:
        transform = _metres(handler.getImuToCameraExtrinsics(left, False, dai.LengthUnit.CENTIMETER))
    except (RuntimeError, IndexError):
        return None
    return transform if math.isfinite(float(transform.sum())) else None
