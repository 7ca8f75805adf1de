"""Kalibr's camchain.yaml. `T_cn_cnm1` maps points of the previous camera to this one: cam1_T_cam0."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import (
    brown,
    numbers,
    padded,
    read_yaml,
    reading,
    rigid,
    rows,
    unsupported,
    write_yaml,
)
from stereo_sfm.calib.formats.imu_files import imu_T_left, read_imu, write_kalibr_imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt

IMU_FILES = ("imu.yaml", "imu_config.yaml", "imu0.yaml")  # next to the camchain


def read_kalibr(path: Path | str, pair: tuple[int, int] = (0, 1)) -> Rig:
    """cam0 and cam1 (or the two cameras of `pair`); the body is the IMU when its pose is known."""
    path = Path(path)
    with reading(path, "Kalibr"):
        data = read_yaml(path)
        first = data[f"cam{pair[0]}"]
        left = _camera(first)
        body_T_left = se3.inverse(rigid(first["T_cam_imu"])) if "T_cam_imu" in first else np.eye(4)
        file = next((f for f in (path.with_name(name) for name in IMU_FILES) if f.is_file()), None)
        imu = None
        if file is not None and "T_cam_imu" in first:
            imu = read_imu(file, se3.inverse(body_T_left), float(first.get("timeshift_cam_imu", 0.0)))
        second = data.get(f"cam{pair[1]}")
        if second is None:
            return Rig(left, body_T_left=body_T_left, imu=imu, name=path.stem)
        if "T_cn_cnm1" in second:
            left_T_right = se3.inverse(rigid(second["T_cn_cnm1"]))
        elif "T_cam_imu" in first and "T_cam_imu" in second:
            left_T_right = se3.inverse(body_T_left) @ se3.inverse(rigid(second["T_cam_imu"]))
        else:
            raise KeyError("T_cn_cnm1")
        return Rig(left, _camera(second), left_T_right, body_T_left, imu=imu, name=path.stem)


def write_kalibr(rig: Rig, path: Path) -> None:
    """A camchain with one or two cameras, T_cam_imu being the pose of the IMU, or of the body without one; imu.yaml.

    Raises:
        StereoSfmError: a lens that it cannot store, or the imu.yaml of another camera lies there.
    """
    left_T_body = se3.inverse(imu_T_left(rig, "kalibr"))
    data = {"cam0": _plain(rig.left, left_T_body)}
    if rig.imu is not None:
        data["cam0"]["timeshift_cam_imu"] = float(rig.imu.offset_s)
    if rig.right is not None:
        right_T_left = se3.inverse(rig.left_T_right)
        data["cam0"]["cam_overlaps"] = [1]
        data["cam1"] = _plain(rig.right, right_T_left @ left_T_body)
        data["cam1"] |= {"cam_overlaps": [0], "T_cn_cnm1": rows(right_T_left)}
        if rig.imu is not None:
            data["cam1"]["timeshift_cam_imu"] = float(rig.imu.offset_s)
    lying = [path.with_name(name) for name in IMU_FILES if path.with_name(name).exists()]
    if lying and not path.exists():
        raise StereoSfmError(f"{lying[0]} would belong to {path.name}: write it into another folder")
    write_yaml(path, data)
    if rig.imu is not None:
        write_kalibr_imu(rig.imu, lying[0] if lying else path.with_name(IMU_FILES[0]))


def _camera(data: dict[str, Any]) -> Camera:
    if data["camera_model"] != "pinhole":
        raise StereoSfmError(f"Kalibr camera model '{data['camera_model']}' is not supported (supported: pinhole)")
    size = numbers(data["resolution"], 2)
    fx, fy, cx, cy = numbers(data["intrinsics"], 4)
    model, coefficients = data["distortion_model"], numbers(data.get("distortion_coeffs", []))
    if model == "equidistant":
        return KannalaBrandt(int(size[0]), int(size[1]), fx, fy, cx, cy, tuple(numbers(coefficients, 4)))
    if model in ("radtan", "none"):
        return brown([int(v) for v in size], (fx, fy), (cx, cy), coefficients if model == "radtan" else ())
    raise StereoSfmError(f"Kalibr distortion model '{model}' is not supported (supported: radtan, equidistant, none)")


def _plain(camera: Camera, cam_T_imu: Any) -> dict[str, Any]:
    kinds = {"kannala_brandt": ("equidistant", 4), "radtan": ("radtan", 4), "pinhole": ("none", 0)}
    if camera.model not in kinds:
        raise unsupported(camera, "Kalibr")
    if camera.model == "radtan" and len(camera.distortion) > 4:
        raise StereoSfmError(
            "Kalibr's radtan has four coefficients, this camera has more: use the format opencv, ros or rig"
        )
    name, count = kinds[camera.model]
    return {
        "T_cam_imu": rows(cam_T_imu),
        "camera_model": "pinhole",
        "intrinsics": [float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)],
        "distortion_model": name,
        "distortion_coeffs": padded(camera, count),
        "resolution": [camera.width, camera.height],
    }
