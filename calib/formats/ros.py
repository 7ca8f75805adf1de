"""ROS camera_info YAML files, one per camera: `left.yaml` and `right.yaml` as written by camera_calibration."""

from __future__ import annotations

from pathlib import Path

from stereo_sfm.calib.formats.camera_info import CameraInfo, info_from_rows, info_rows, infos_from_rig, rig_from_infos
from stereo_sfm.calib.formats.common import read_yaml, reading, write_yaml
from stereo_sfm.calib.rig import Rig

_PARTNERS = (("left", "right"), ("cam0", "cam1"), ("camera0", "camera1"), ("fisheye1", "fisheye2"))


def read_ros(path: Path | str) -> Rig:
    """A folder with left.yaml and right.yaml, or the left file; without a right file the rig has one camera."""
    left = Path(path)
    with reading(left, "ROS camera_info"):
        if left.is_dir():
            left = next(
                (left / f"{a}.yaml" for a, _ in _PARTNERS if (left / f"{a}.yaml").is_file()), left / "left.yaml"
            )
        right = _partner(left)
        return rig_from_infos(_info(left), _info(right) if right else None, left.parent.name)


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


def _partner(left: Path) -> Path | None:
    for a, b in _PARTNERS:
        other = left.with_name(left.name.replace(a, b))
        if a in left.name and other.is_file():
            return other
    return None


def _info(path: Path) -> CameraInfo:
    with reading(path, "ROS camera_info"):
        data = read_yaml(path)
        return info_from_rows(
            data["image_width"],
            data["image_height"],
            data["distortion_model"],
            data["camera_matrix"]["data"],
            data["distortion_coefficients"]["data"],
            data.get("rectification_matrix", {}).get("data"),
            data.get("projection_matrix", {}).get("data"),
        )
