"""Our own rig file: YAML with every field of `Rig`, lossless."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import numbers, read_text, reading, rigid, rows, yaml_mapping, yaml_text
from stereo_sfm.calib.formats.imu_files import imu_from_plain, imu_to_plain
from stereo_sfm.calib.formats.wheel_files import wheel_from_plain, wheel_to_plain
from stereo_sfm.calib.mask import mask_from_text, mask_to_text
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry.cameras import MODELS, Camera
from stereo_sfm.types import Bool

KEY = "stereo_sfm_rig"


def read_native(path: Path) -> Rig:
    """Read a `rig.yaml` as written by `write_native`."""
    with reading(path, "rig"):
        text = read_text(path)
    return rig_from_text(text, path, path.parent)


def rig_from_text(text: str, where: Path | str, folder: Path | None = None) -> Rig:
    """The inverse of `rig_to_text`.

    Args:
        text: YAML. where: its origin, for error messages. folder: of the mask files that it names; None: it may not.
    """
    with reading(where, "rig"):
        return rig_from_plain(yaml_mapping(text), folder)


def rig_from_plain(data: dict[str, Any], folder: Path | None = None) -> Rig:
    """The inverse of `rig_to_plain`; `folder` as of `rig_from_text`.

    Raises:
        KeyError, TypeError, ValueError: not a rig.
        StereoSfmError: one that cannot be.
    """
    if data.get(KEY) != 1:
        raise ValueError(f"{KEY} is {data.get(KEY)}, this version of the program reads 1")
    body_T_left = rigid(data["body_T_left"]) if "body_T_left" in data else np.eye(4)
    return Rig(
        left=_camera(data["left"]),
        right=_camera(data["right"]) if data.get("right") else None,
        left_T_right=rigid(data["left_T_right"]),
        body_T_left=body_T_left,
        depth=bool(data.get("depth", False)),
        name=str(data.get("name", "")),
        serial=str(data.get("serial", "")),
        imu=imu_from_plain(data["imu"]) if data.get("imu") else None,
        wheel=wheel_from_plain(data["wheel"], body_T_left) if data.get("wheel") else None,
        readout_s=float(data.get("readout_s") or 0.0),
        left_mask=_mask(data["left"], folder),
        right_mask=_mask(data.get("right") or {}, folder),
    )


def write_native(rig: Rig, path: Path) -> None:
    """Write every field; `read_native` restores the same bits."""
    path.write_text(rig_to_text(rig), encoding="utf-8")


def rig_to_text(rig: Rig) -> str:
    """The rig as YAML, lossless."""
    return yaml_text(rig_to_plain(rig))


def rig_to_plain(rig: Rig) -> dict[str, Any]:
    """The rig as plain values, lossless."""
    return {
        KEY: 1,
        "name": rig.name,
        "serial": rig.serial,
        "depth": rig.depth,
        "readout_s": float(rig.readout_s),
        "left": _plain(rig.left, rig.left_mask),
        "right": _plain(rig.right, rig.right_mask) if rig.right else None,
        "left_T_right": rows(rig.left_T_right),
        "body_T_left": rows(rig.body_T_left),
        **({"imu": imu_to_plain(rig.imu)} if rig.imu else {}),
        **({"wheel": wheel_to_plain(rig.wheel)} if rig.wheel else {}),
    }


def _camera(data: dict[str, Any]) -> Camera:
    model = MODELS.get(data["model"])
    if model is None:
        raise ValueError(f"unknown camera model '{data['model']}' (known: {', '.join(MODELS)})")
    width, height = (int(v) for v in numbers(data["size"], 2))
    (fx, fy), (cx, cy) = numbers(data["focal"], 2), numbers(data["centre"], 2)
    return model(width, height, fx, fy, cx, cy, tuple(numbers(data["distortion"])))


def _mask(data: dict[str, Any], folder: Path | None) -> Bool | None:
    return mask_from_text(str(data["mask"]), folder) if data.get("mask") else None


def _plain(camera: Camera, mask: Bool | None) -> dict[str, Any]:
    return {
        "model": camera.model,
        "size": [camera.width, camera.height],
        "focal": [float(camera.fx), float(camera.fy)],
        "centre": [float(camera.cx), float(camera.cy)],
        "distortion": list(camera.distortion),
        **({"mask": mask_to_text(mask)} if mask is not None else {}),
    }
