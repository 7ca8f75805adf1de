"""Calibration of an IMU: the keys of our rig file, EuRoC's sensor.yaml, Kalibr's imu.yaml and time shift."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import numbers, read_yaml, reading, rigid, rows
from stereo_sfm.calib.imu import Imu
from stereo_sfm.types import F64

_NOISE = {  # ours -> EuRoC's and Kalibr's
    "gyro_noise": "gyroscope_noise_density",
    "accel_noise": "accelerometer_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "accel_walk": "accelerometer_random_walk",
}
_OTHERS = "gyro_bias_sigma", "accel_bias_sigma", "rate_hz", "offset_s"


def imu_to_plain(imu: Imu) -> dict[str, Any]:
    """Keys of our own rig file."""
    return {
        "left_T_imu": rows(imu.left_T_imu),
        "gyro_matrix": rows(imu.gyro_matrix),
        "gyro_bias": imu.gyro_bias.tolist(),
        "accel_matrix": rows(imu.accel_matrix),
        "accel_bias": imu.accel_bias.tolist(),
        **{name: float(getattr(imu, name)) for name in (*_NOISE, *_OTHERS)},
    }


def imu_from_plain(data: dict[str, Any]) -> Imu:
    """The inverse of `imu_to_plain`; missing keys get their defaults."""
    known: dict[str, Any] = {"left_T_imu": rigid(data["left_T_imu"])}
    for name, shape in (("gyro_matrix", (3, 3)), ("gyro_bias", (3,)), ("accel_matrix", (3, 3)), ("accel_bias", (3,))):
        if name in data:
            known[name] = np.array(numbers(data[name], int(np.prod(shape)))).reshape(shape)
    known |= {name: float(data[name]) for name in (*_NOISE, *_OTHERS) if name in data}
    unknown = set(data) - set(known)
    if unknown:
        raise ValueError(f"unknown IMU key: {', '.join(sorted(unknown))}")
    return Imu(**known)


def read_imu(path: Path, left_T_body: F64, offset_s: float = 0.0) -> Imu:
    """EuRoC's `imu0/sensor.yaml` (`T_BS` is body_T_imu) or Kalibr's imu.yaml, where the body is the IMU.

    Args:
        path: the file. left_T_body: (4, 4) of the rig. offset_s: Kalibr's timeshift_cam_imu, from the camchain.

    Raises:
        StereoSfmError: malformed.
    """
    with reading(path, "IMU"):
        data = read_yaml(path)
        data = data.get("imu0", data)
        body_T_imu = rigid(data["T_BS"]["data"] if isinstance(data.get("T_BS"), dict) else data.get("T_i_b", np.eye(4)))
        known: dict[str, Any] = {ours: float(data[theirs]) for ours, theirs in _NOISE.items() if theirs in data}
        rate = data.get("rate_hz", data.get("update_rate", 200.0))
        return Imu(left_T_imu=left_T_body @ body_T_imu, rate_hz=float(rate), offset_s=offset_s, **known)
