"""ROS camera_info YAML files, one per camera: `left.yaml` and `right.yaml` as written by camera_calibration."""

from __future__ import annotations

import logging
from pathlib import Path

from stereo_sfm.calib.formats.camera_info import (
    CameraInfo,
    extrinsics,
    info_from_rows,
    info_rows,
    infos_from_rig,
    rig_from_infos,
)
from stereo_sfm.calib.formats.common import no_other_distortion, read_yaml, reading, write_yaml
from stereo_sfm.calib.formats.pair_files import left_files, partner
from stereo_sfm.calib.rig import Rig
from stereo_sfm.input_file import visible

log = logging.getLogger("stereo_sfm")


def read_ros(path: Path | str, lens: str = "", unit: float = 1.0) -> Rig:
    """A folder with left.yaml and right.yaml, or the left file; without a right file the rig has one camera.

    Args:
        path: the folder or file. lens: the lens model's name instead of the files'. unit: of P's lengths, in metres.
    """
    left = Path(path)
    with reading(left, "ROS camera_info"):
        if left.is_dir():
            left = next(iter(left_files(left, ".yaml", ".yml") or sorted(visible(left, "*.yaml"))), left / "left.yaml")
        info, other = _info(left), partner(left)
        right = _info(other) if other else None
        if right is not None and "right" not in str(other) and extrinsics(info, right) is None:
            log.warning("%s and %s are no pair (P of the second has no Tx): only the first is read", left, other)
            right = None
        return rig_from_infos(info, right, left.parent.name, lens, unit)


def write_ros(rig: Rig, folder: Path) -> None:
    """`folder/left.yaml` and `folder/right.yaml`. The body's pose is not stored."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, info in zip(("left", "right"), infos_from_rig(rig, "equidistant"), strict=False):
        flat = info_rows(info)
        write_yaml(
            folder / f"{name}.yaml",
            {
                "image_width": info.width,
                "image_height": info.height,
                "camera_name": name,
                "camera_matrix": {"rows": 3, "cols": 3, "data": flat["K"]},
                "distortion_model": info.distortion_model,
                "distortion_coefficients": {"rows": 1, "cols": len(flat["D"]), "data": flat["D"]},
                "rectification_matrix": {"rows": 3, "cols": 3, "data": flat["R"]},
                "projection_matrix": {"rows": 3, "cols": 4, "data": flat["P"]},
            },
        )


def _info(path: Path) -> CameraInfo:
    with reading(path, "ROS camera_info"):
        data = read_yaml(path)
        if "distortion_coefficients" not in data:
            no_other_distortion(data, "distortion_coefficients")
        return info_from_rows(
            data["image_width"],
            data["image_height"],
            data.get("distortion_model"),
            data["camera_matrix"]["data"],
            data.get("distortion_coefficients", {}).get("data"),
            data.get("rectification_matrix", {}).get("data"),
            data.get("projection_matrix", {}).get("data"),
        )
