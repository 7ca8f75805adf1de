"""Basalt's calibration.json (cereal): `T_imu_cam` maps camera points to the body; models kb4, pinhole, radtan8.

Its body is the IMU, in whose axes the matrix of the accelerometer is lower triangular; a sample is corrected as
raw + scale @ raw - bias.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import brown, numbers, padded, pose_dict, read_json, reading, unsupported
from stereo_sfm.calib.formats.imu_files import imu_T_left
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, DoubleSphere, Eucm, KannalaBrandt
from stereo_sfm.types import F64

_LOWER = (np.array([0, 1, 2, 1, 2, 2]), np.array([0, 0, 0, 1, 1, 2]))  # of a matrix, by columns
_NOISE = {  # ours -> Basalt's, densities, the same for three axes
    "accel_noise": "accel_noise_std",
    "gyro_noise": "gyro_noise_std",
    "accel_walk": "accel_bias_std",
    "gyro_walk": "gyro_bias_std",
}
_SPHERES: dict[str, tuple[type[Camera], tuple[str, ...]]] = {  # the ucm has no beta, which is 1
    "ds": (DoubleSphere, DoubleSphere.coefficients),
    "eucm": (Eucm, Eucm.coefficients),
    "ucm": (Eucm, Eucm.coefficients),
}
_RADTAN8 = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def read_basalt(path: Path | str, pair: tuple[int, int] = (0, 1), unit: float = 1.0) -> Rig:
    """The two cameras of `pair`, or the only one; `unit`: of lengths, in metres."""
    path = Path(path)
    with reading(path, "Basalt"):
        data = read_json(path)["value0"]
        poses = [_pose(p, unit) for p in data["T_imu_cam"]]
        cameras = [_camera(c, r) for c, r in zip(data["intrinsics"], data["resolution"], strict=True)]
        a, b = pair if len(cameras) > 1 else (0, 0)
        imu = _imu(data, se3.inverse(poses[a])) if "imu_update_rate" in data else None
        if len(cameras) < 2:
            return Rig(cameras[a], body_T_left=poses[a], imu=imu, name=path.stem)
        return Rig(cameras[a], cameras[b], se3.inverse(poses[a]) @ poses[b], poses[a], imu=imu, name=path.stem)


def write_basalt(rig: Rig, path: Path) -> None:
    """Intrinsics, extrinsics and resolution; without an IMU Basalt uses its defaults."""
    imu = None if rig.imu is None else _with_triangular_matrix(rig.imu)
    body_T_left = imu_T_left(replace(rig, imu=imu), "basalt")
    cameras = [(rig.left, body_T_left)]
    if rig.right is not None:
        cameras.append((rig.right, body_T_left @ rig.left_T_right))
    value = {
        "T_imu_cam": [pose_dict(body_T_cam) for _, body_T_cam in cameras],
        "intrinsics": [_plain(camera) for camera, _ in cameras],
        "resolution": [[camera.width, camera.height] for camera, _ in cameras],
        "cam_time_offset_ns": 0 if imu is None else round(imu.offset_s * 1e9),
        "vignette": [],
        **({} if imu is None else _plain_imu(imu)),
    }
    path.write_text(json.dumps({"value0": value}, indent=2) + "\n", encoding="utf-8")


def _imu(data: dict[str, Any], left_T_imu: F64) -> Imu:
    accel, gyro = numbers(data["calib_accel_bias"], 9), numbers(data["calib_gyro_bias"], 12)
    accel_matrix, gyro_matrix = np.eye(3), np.eye(3) + np.array(gyro[3:]).reshape(3, 3).T
    accel_matrix[_LOWER] += accel[3:]
    noise = {ours: float(numbers(data[theirs], 3)[0]) for ours, theirs in _NOISE.items()}
    return Imu(
        left_T_imu=left_T_imu, gyro_matrix=gyro_matrix, gyro_bias=np.array(gyro[:3]), accel_matrix=accel_matrix,
        accel_bias=np.array(accel[:3]), rate_hz=float(data["imu_update_rate"]),
        offset_s=1e-9 * int(data.get("cam_time_offset_ns", 0)), **noise,
    )  # fmt: skip


def _plain_imu(imu: Imu) -> dict[str, Any]:
    accel, gyro = (imu.accel_matrix - np.eye(3))[_LOWER], (imu.gyro_matrix - np.eye(3)).T.ravel()
    noise = {theirs: [float(getattr(imu, ours))] * 3 for ours, theirs in _NOISE.items()}
    return {
        "calib_accel_bias": [*imu.accel_bias.tolist(), *accel.tolist()],
        "calib_gyro_bias": [*imu.gyro_bias.tolist(), *gyro.tolist()],
        "imu_update_rate": float(imu.rate_hz),
        **noise,
    }


def _with_triangular_matrix(imu: Imu) -> Imu:
    """The same sensor in axes in which the accelerometer's matrix is lower triangular."""
    q, r = np.linalg.qr(imu.accel_matrix[::-1, ::-1])  # flipped both ways: lower becomes upper
    turn = (q * np.sign(np.diag(r)))[::-1, ::-1]
    turned = imu.in_axes(imu.left_T_imu[:3, :3] @ turn)
    return replace(turned, accel_matrix=np.tril(turned.accel_matrix))


def _pose(data: dict[str, float], unit: float) -> F64:
    quaternion = np.array([data[k] for k in ("qx", "qy", "qz", "qw")], float)
    translation = unit * np.array([data[k] for k in ("px", "py", "pz")], float)
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
    if kind in _SPHERES:
        model, names = _SPHERES[kind]
        return model.published(width, height, fx, fy, cx, cy, tuple(numbers([p.get(k, 1.0) for k in names])))
    raise ValueError(
        f"camera type '{kind}' is not supported (supported: kb4, pinhole, pinhole-radtan8, {', '.join(_SPHERES)})"
    )


def _plain(camera: Camera) -> dict[str, Any]:
    fx, fy = camera.published_focal
    p = {"fx": fx, "fy": fy, "cx": camera.cx, "cy": camera.cy}
    if camera.model == "kannala_brandt":
        kind = "kb4"
        p |= dict(zip(("k1", "k2", "k3", "k4"), padded(camera, 4), strict=True))
    elif camera.model == "radtan":
        kind = "pinhole-radtan8"
        p |= dict(zip(_RADTAN8, padded(camera, 8), strict=True)) | {"rpmax": float(np.sqrt(camera.params[12]))}
    elif camera.model == "pinhole":
        kind = "pinhole"
    else:
        found = [(name, names) for name, (model, names) in _SPHERES.items() if isinstance(camera, model)]
        if not found:
            raise unsupported(camera, "Basalt")
        kind, names = found[0]
        p |= dict(zip(names, padded(camera, len(names)), strict=True))
    return {"camera_type": kind, "intrinsics": p}
