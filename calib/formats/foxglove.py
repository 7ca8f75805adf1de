"""Foxglove CameraCalibration messages as JSON: one message, or a list of two (left, right)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from stereo_sfm.calib.formats.camera_info import (
    CameraInfo,
    check_pair,
    info_from_rows,
    info_rows,
    infos_from_rig,
    rig_from_infos,
)
from stereo_sfm.calib.formats.common import read_json, reading
from stereo_sfm.calib.rig import Rig


def read_foxglove(path: Path | str, lens: str = "", unit: float = 1.0) -> Rig:
    """One rig from one file; `lens` and `unit` as for `read_ros`."""
    path = Path(path)
    with reading(path, "Foxglove"):
        data = read_json(path)
        messages = data if isinstance(data, list) else [data]
        left, right = check_pair([_info(m) for m in messages], str(path))
        return rig_from_infos(left, right, path.stem, lens, unit)


def write_foxglove(rig: Rig, path: Path) -> None:
    """A JSON list with one message per camera. The body's pose is not stored."""
    messages = [
        {
            "timestamp": {"sec": 0, "nsec": 0},
            "frame_id": frame,
            "width": info.width,
            "height": info.height,
            "distortion_model": info.distortion_model,
            **info_rows(info),
        }
        for frame, info in zip(("cam0", "cam1"), infos_from_rig(rig, "kannala_brandt"), strict=False)
    ]
    path.write_text(json.dumps(messages, indent=2) + "\n", encoding="utf-8")


def _info(data: dict[str, Any]) -> CameraInfo:
    return info_from_rows(
        data["width"],
        data["height"],
        data.get("distortion_model", ""),
        data["K"],
        data.get("D", []),
        data.get("R"),
        data.get("P"),
    )
