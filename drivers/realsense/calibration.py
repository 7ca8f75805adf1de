"""The calibration of an infrared pair and its IMU from the profiles of their streams."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import brown
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.live.errors import DeviceFault
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole
from stereo_sfm.types import F64


def read_rig(rs: Any, left: Any, right: Any, gyro: Any | None, name: str, serial: str) -> Rig:
    """The rig of the profiles of both infrared streams, and of the gyroscope's, None without one.

    Raises:
        DeviceFault: an unknown lens model, or extrinsics that are none.
    """
    left_T_right = _transform(right, left)
    if not 1e-3 < left_T_right[0, 3] < 1.0:
        raise DeviceFault(f"RealSense {serial}: invalid extrinsics, right camera at {left_T_right[:3, 3]} m")
    imu = None if gyro is None else Imu(_transform(gyro, left))
    lenses = [_camera(rs, one.as_video_stream_profile().get_intrinsics()) for one in (left, right)]
    return Rig(lenses[0], lenses[1], left_T_right, imu=imu, name=name, serial=serial)


def _camera(rs: Any, lens: Any) -> Camera:
    numbers = (lens.fx, lens.fy), (lens.ppx, lens.ppy)
    coefficients = [float(c) for c in lens.coeffs]
    size = lens.width, lens.height
    if not any(coefficients) and lens.model != rs.distortion.kannala_brandt4:
        return Pinhole(*size, *numbers[0], *numbers[1])
    if lens.model == rs.distortion.kannala_brandt4:
        return KannalaBrandt(*size, *numbers[0], *numbers[1], tuple(coefficients[:4]))
    if lens.model == rs.distortion.brown_conrady:
        return brown(size, *numbers, coefficients)
    raise DeviceFault(f"unsupported lens model {lens.model} of the RealSense: calibrate it with 'stereo-sfm calibrate'")


def _transform(source: Any, target: Any) -> F64:
    """(4, 4) target_T_source of two stream profiles, m; librealsense's rotations are by columns."""
    found = source.get_extrinsics_to(target)
    rotation = np.array(found.rotation, float).reshape(3, 3).T
    return se3.orthonormalize(se3.from_rotation_translation(rotation, np.array(found.translation, float)))
