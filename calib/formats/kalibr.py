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
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, DoubleSphere, Eucm, Fov, KannalaBrandt, Mei, Pinhole
from stereo_sfm.types import F64

IMU_FILES = ("imu.yaml", "imu_config.yaml", "imu0.yaml", "kalibr_imu_chain.yaml")  # next to the camchain
# Camera model -> ours and how many of its coefficients stand before the focal lengths.
_MODELS: dict[str, tuple[type[Camera], int]] = {
    "omni": (Mei, 1),
    "ds": (DoubleSphere, 2),
    "eucm": (Eucm, 2),
    "pinhole": (Pinhole, 0),
}


def read_kalibr(
    path: Path | str, pair: tuple[int, int] = (0, 1), imu_file: Path | None = None, unit: float = 1.0
) -> Rig:
    """The two cameras of `pair`; the body is the IMU when its pose is known.

    OpenVINS's file, whose T_imu_cam are the inverse of Kalibr's T_cam_imu, is read, too.

    Args:
        path: the camchain. pair: numbers of the left and the right camera.
        imu_file: Kalibr's imu.yaml; None: one of `IMU_FILES` beside the camchain. unit: of lengths, in metres.
    """
    path = Path(path)
    with reading(path, "Kalibr"):
        data = read_yaml(path)
        first, second = data[f"cam{pair[0]}"], data.get(f"cam{pair[1]}")
        left = _camera(first)
        left_T_imu = _cam_T_imu(first, unit)
        body_T_left = np.eye(4) if left_T_imu is None else se3.inverse(left_T_imu)
        beside = (*IMU_FILES, path.name.replace("camchain-imucam", "imu"))
        files = [path.with_name(name) for name in beside] if imu_file is None else [imu_file]
        files = [file for file in files if file != path]
        file, imu = next((f for f in files if f.is_file()), None), None
        if file is not None and left_T_imu is not None:
            imu = read_imu(file, left_T_imu, float(first.get("timeshift_cam_imu", 0.0)))
        elif left_T_imu is not None and "timeshift_cam_imu" in first:  # calibrated with an IMU, of usual noise
            imu = Imu(left_T_imu, offset_s=float(first["timeshift_cam_imu"]))
        if second is None:
            if pair != (0, 1):
                raise KeyError(f"cam{pair[1]}")
            return Rig(left, body_T_left=body_T_left, imu=imu, name=path.stem)
        return Rig(left, _camera(second), _left_T_right(data, pair, unit), body_T_left, imu=imu, name=path.stem)


def _cam_T_imu(camera: dict[str, Any], unit: float) -> F64 | None:
    """(4, 4), None where it is not known."""
    if "T_imu_cam" in camera:
        return se3.inverse(rigid(camera["T_imu_cam"], unit))
    return rigid(camera["T_cam_imu"], unit) if "T_cam_imu" in camera else None


def _left_T_right(data: dict[str, Any], pair: tuple[int, int], unit: float) -> F64:
    """(4, 4) by the product of T_cn_cnm1 between the two cameras, else by the poses of both to the IMU."""
    first, last = sorted(pair)
    between = [data.get(f"cam{k}", {}) for k in range(first + 1, last + 1)]
    if all("T_cn_cnm1" in camera for camera in between):
        last_T_first = np.eye(4)
        for camera in between:
            last_T_first = rigid(camera["T_cn_cnm1"], unit) @ last_T_first
        return se3.inverse(last_T_first) if first == pair[0] else last_T_first
    left_T_imu, right_T_imu = (_cam_T_imu(data[f"cam{k}"], unit) for k in pair)
    if left_T_imu is None or right_T_imu is None:
        raise KeyError("T_cn_cnm1")
    return left_T_imu @ se3.inverse(right_T_imu)


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
    width, height = (int(v) for v in numbers(data["resolution"], 2))
    kind, distortion = data["camera_model"], data.get("distortion_model", "none")
    coefficients = numbers(data.get("distortion_coeffs") or []) if distortion != "none" else []
    model, before = _MODELS.get(kind, (None, 0))
    if model is None:
        raise StereoSfmError(f"Kalibr camera model '{kind}' is not supported (supported: {', '.join(_MODELS)})")
    *own, fx, fy, cx, cy = numbers(data["intrinsics"], 4 + before)
    if kind == "pinhole" and distortion in ("equidistant", "fov"):
        lens, count = (KannalaBrandt, 4) if distortion == "equidistant" else (Fov, 1)
        return lens.published(width, height, fx, fy, cx, cy, tuple(numbers(coefficients, count)))
    if kind == "pinhole" and distortion in ("radtan", "none"):
        return brown((width, height), (fx, fy), (cx, cy), coefficients)
    if distortion == "none" or (kind == "omni" and distortion == "radtan"):
        return model.published(width, height, fx, fy, cx, cy, (*own, *coefficients))
    allowed = {"pinhole": "radtan, equidistant, fov, none", "omni": "radtan, none"}.get(kind, "none")
    raise StereoSfmError(f"Kalibr distortion model '{distortion}' of {kind} is not supported (supported: {allowed})")


def _plain(camera: Camera, cam_T_imu: Any) -> dict[str, Any]:
    kinds = {
        "kannala_brandt": ("equidistant", 4), "radtan": ("radtan", 4), "pinhole": ("none", 0), "fov": ("fov", 1),
        "mei": ("radtan", 4), "double_sphere": ("none", 0), "eucm": ("none", 0),
    }  # fmt: skip
    if camera.model not in kinds:
        raise unsupported(camera, "Kalibr")
    if camera.model == "radtan" and len(camera.distortion) > 4:
        raise StereoSfmError(
            "Kalibr's radtan has four coefficients, this camera has more: use the format opencv, ros or rig"
        )
    kind, before = next((k, n) for k, (model, n) in _MODELS.items() if isinstance(camera, model) or k == "pinhole")
    name, count = kinds[camera.model]
    coefficients = padded(camera, before + count)
    return {
        "T_cam_imu": rows(cam_T_imu),
        "camera_model": kind,
        "intrinsics": [*coefficients[:before], *camera.published_focal, float(camera.cx), float(camera.cy)],
        "distortion_model": name,
        "distortion_coeffs": coefficients[before:],
        "resolution": [camera.width, camera.height],
    }
