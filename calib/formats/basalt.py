"""Basalt's calibration.json (cereal): `T_imu_cam` maps camera points to the body; models kb4, pinhole, radtan8."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import brown, numbers, padded, pose_dict, read_json, reading, unsupported
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt
from stereo_sfm.types import F64

_RADTAN8 = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def read_basalt(path: Path | str) -> Rig:
    """The first one or two cameras."""
    path = Path(path)
    with reading(path, "Basalt"):
        data = read_json(path)["value0"]
        poses = [_pose(p) for p in data["T_imu_cam"]]
        cameras = [_camera(c, r) for c, r in zip(data["intrinsics"], data["resolution"], strict=True)]
        if len(cameras) < 2:
            return Rig(cameras[0], body_T_left=poses[0], name=path.stem)
        return Rig(cameras[0], cameras[1], se3.inverse(poses[0]) @ poses[1], poses[0], name=path.stem)


def write_basalt(rig: Rig, path: Path) -> None:
    """Intrinsics, extrinsics and resolution; Basalt uses its defaults for the IMU."""
    cameras = [(rig.left, rig.body_T_left)]
    if rig.right is not None:
        cameras.append((rig.right, rig.body_T_left @ rig.left_T_right))
    value = {
        "T_imu_cam": [pose_dict(body_T_cam) for _, body_T_cam in cameras],
        "intrinsics": [_plain(camera) for camera, _ in cameras],
        "resolution": [[camera.width, camera.height] for camera, _ in cameras],
        "cam_time_offset_ns": 0,
        "vignette": [],
    }
    path.write_text(json.dumps({"value0": value}, indent=2) + "\n", encoding="utf-8")


def _pose(data: dict[str, float]) -> F64:
    quaternion = np.array([data[k] for k in ("qx", "qy", "qz", "qw")], float)
    translation = np.array([data[k] for k in ("px", "py", "pz")], float)
    return se3.from_rotation_translation(se3.rotation_from_quaternion(quaternion), translation)


def _camera(data: dict[str, Any], resolution: Any) -> Camera:
    kind, p = data["camera_type"], data["intrinsics"]
    width, height = (int(v) for v in numbers(resolution, 2))
    fx, fy, cx, cy = numbers([p[k] for k in ("fx", "fy", "cx", "cy")])
    if kind == "kb4":
        return KannalaBrandt(width, height, fx, fy, cx, cy, tuple(numbers([p[f"k{i}"] for i in range(1, 5)])))
    if kind in ("pinhole", "pinhole-radtan8"):
        coefficients = [] if kind == "pinhole" else numbers([p[k] for k in _RADTAN8])
        return brown((width, height), (fx, fy), (cx, cy), coefficients)
    raise ValueError(f"camera type '{kind}' is not supported (supported: kb4, pinhole, pinhole-radtan8)")


def _plain(camera: Camera) -> dict[str, Any]:
    p = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    if camera.model == "kannala_brandt":
        kind = "kb4"
        p |= dict(zip(("k1", "k2", "k3", "k4"), padded(camera, 4), strict=True))
    elif camera.model == "radtan":
        kind = "pinhole-radtan8"
        p |= dict(zip(_RADTAN8, padded(camera, 8), strict=True)) | {"rpmax": float(np.sqrt(camera.params[12]))}
    elif camera.model == "pinhole":
        kind = "pinhole"
    else:
        raise unsupported(camera, "Basalt")
    return {"camera_type": kind, "intrinsics": p}
