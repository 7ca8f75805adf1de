"""Calibration of an IMU: the keys of our rig file, EuRoC's sensor.yaml, Kalibr's imu.yaml and time shift."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import numbers, read_yaml, reading, rigid, rows, write_yaml
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

log = logging.getLogger("stereo_sfm")

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


def imu_T_left(rig: Rig, format: str) -> F64:
    """(4, 4) for formats whose body is the IMU; body_T_left without one. A warning if another body is lost."""
    if rig.imu is None:
        return rig.body_T_left
    found = se3.inverse(rig.imu.left_T_imu)
    if not (np.allclose(rig.body_T_left, found, atol=1e-9) or np.array_equal(rig.body_T_left, np.eye(4))):
        log.warning("the body is the IMU in %s, body_T_left of the rig is lost: the format 'rig' keeps it", format)
    return found


def warn_of_lost(imu: Imu, format: str, offset: bool = False, affine: bool = False) -> None:
    """About what a format that stores pose and noise has no place for; `offset`: it stores the time offset, `affine`:
    scale, misalignment and biases."""
    lost: list[str] = []
    if not affine and not (np.array_equal(imu.gyro_matrix, np.eye(3)) and np.array_equal(imu.accel_matrix, np.eye(3))):
        lost.append("scale and misalignment")
    if not affine and (imu.gyro_bias.any() or imu.accel_bias.any()):
        lost.append("biases")
    if imu.offset_s and not offset:
        lost.append("time offset")
    if lost:
        log.warning(
            "%s cannot store %s of an IMU, which are lost: the format 'rig' keeps them", format, " and ".join(lost)
        )


def _noise(imu: Imu) -> dict[str, float]:
    return {theirs: float(getattr(imu, ours)) for ours, theirs in _NOISE.items()}


def write_kalibr_imu(imu: Imu, path: Path) -> None:
    """imu.yaml."""
    warn_of_lost(imu, "kalibr", offset=True)
    write_yaml(path, _noise(imu) | {"rostopic": "/imu0", "update_rate": float(imu.rate_hz)})


def write_euroc_imu(imu: Imu, body_T_imu: F64, path: Path) -> None:
    """imu0/sensor.yaml."""
    warn_of_lost(imu, "euroc")
    pose = {"cols": 4, "rows": 4, "data": [float(v) for v in body_T_imu.ravel()]}
    head = {"sensor_type": "imu", "comment": "imu0", "T_BS": pose, "rate_hz": float(imu.rate_hz)}
    write_yaml(path, head | _noise(imu))
