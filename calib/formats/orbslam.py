"""Settings files of ORB-SLAM2 and ORB-SLAM3, as calibrations of the cameras and the IMU. Only read.

Lengths are metres. `Stereo.T_c1_c2` (`Tlr` before version 1.0) takes points of the right camera into the left one, and
`IMU.T_b_c1` (`Tbc`) those of the left camera into the IMU, which is the body.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.camera_info import CameraInfo, info_from_rows, rig_from_infos
from stereo_sfm.calib.formats.common import numbers, reading, rigid
from stereo_sfm.calib.formats.settings_files import Lenses, read_flat, rectified_pair
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3

_NOISE = {  # ours -> densities, as in its Settings.cc
    "gyro_noise": "IMU.NoiseGyro",
    "accel_noise": "IMU.NoiseAcc",
    "gyro_walk": "IMU.GyroWalk",
    "accel_walk": "IMU.AccWalk",
    "rate_hz": "IMU.Frequency",
}
_LENSES = Lenses(
    "Camera.type", {"pinhole": False, "rectified": False, "kannalabrandt8": True}, ("Camera.width", "Camera.height")
)
_DEPTH = ("DepthMapFactor", "RGBD.DepthMapFactor")  # of files for a camera with depth, whose baseline is virtual


def read_orbslam(path: Path | str, size: tuple[int, int] | None = None, unit: float = 1.0) -> Rig:
    """One camera or a stereo pair.

    Args:
        path: the file. size: (width, height) px where it states none. unit: of lengths, in metres.
    """
    path = Path(path)
    with reading(path, "ORB-SLAM"):
        data = read_flat(path)
        rig = _cameras(data, path.stem, size, unit)
        pose = data.get("IMU.T_b_c1", data.get("Tbc"))
        if pose is None:
            return rig
        body_T_left = rigid(pose, unit)
        noise: dict[str, Any] = {ours: float(data[theirs]) for ours, theirs in _NOISE.items() if theirs in data}
        return replace(rig, body_T_left=body_T_left, imu=Imu(se3.inverse(body_T_left), **noise))


def _cameras(data: dict[str, Any], name: str, size: tuple[int, int] | None, unit: float) -> Rig:
    if "LEFT.K" in data:  # ORB-SLAM2: original images, rectified by the program
        return rig_from_infos(_info(data, "LEFT."), _info(data, "RIGHT."), name, unit=unit)
    left = _LENSES.of(data, size, "Camera1.", "Camera.")
    if any(key in data for key in _DEPTH):
        return Rig(left, name=name)
    pose = data.get("Stereo.T_c1_c2", data.get("Tlr"))
    if pose is not None and "Camera2.fx" in data:
        return Rig(left, _LENSES.of(data, size, "Camera2."), rigid(pose, unit), name=name)
    if "Stereo.b" in data:
        return rectified_pair(left, unit * float(data["Stereo.b"]), name)
    if "Camera.bf" in data:
        return rectified_pair(left, unit * float(data["Camera.bf"]) / left.fx, name)
    return Rig(left, name=name)


def _info(data: dict[str, Any], prefix: str) -> CameraInfo:
    k, d, r, p = (numbers(data[prefix + key]) for key in "KDRP")
    width, height = numbers([data[f"{prefix}width"], data[f"{prefix}height"]])
    return info_from_rows(int(width), int(height), "plumb_bob", k, np.array(d), r, p)
