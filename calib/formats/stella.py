"""Settings files of stella_vslam and OpenVSLAM, as calibrations. Only read.

`Camera` holds the camera after rectification with `focal_x_baseline`; `StereoRectifier` the original ones, if the
images are not rectified.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stereo_sfm.calib.formats.camera_info import CameraInfo, info_from_rows, rig_from_infos
from stereo_sfm.calib.formats.common import numbers, reading
from stereo_sfm.calib.formats.settings_files import image_size, lens, read_flat, rectified_pair
from stereo_sfm.calib.rig import Rig

_MODELS = ("perspective", "fisheye")


def read_stella(path: Path | str, size: tuple[int, int] | None = None) -> Rig:
    """One camera or a stereo pair.

    Args:
        path: the file. size: (width, height) px where it states none.
    """
    path = Path(path)
    with reading(path, "stella_vslam"):
        data = read_flat(path)
        model = str(data["Camera.model"]).lower()
        if model not in _MODELS:
            raise ValueError(f"camera model '{model}' is not supported (supported: {', '.join(_MODELS)})")
        size = image_size(data, ("Camera.cols", "Camera.rows"), size)
        if str(data.get("Camera.setup", "monocular")).lower() != "stereo":
            return Rig(lens(data, "Camera.", model == "fisheye", size), name=path.stem)
        if "StereoRectifier.K_left" in data:
            return rig_from_infos(_info(data, "left", size), _info(data, "right", size), path.stem)
        left = lens(data, "Camera.", model == "fisheye", size)
        return rectified_pair(left, float(data["Camera.focal_x_baseline"]) / left.fx, path.stem)


def _info(data: dict[str, Any], side: str, size: tuple[int, int]) -> CameraInfo:
    k, d, r = (numbers(data[f"StereoRectifier.{key}_{side}"]) for key in "KDR")
    fx, fy, cx, cy = numbers([data[f"Camera.{name}"] for name in ("fx", "fy", "cx", "cy")])
    shift = 0.0 if side == "left" else -float(data["Camera.focal_x_baseline"])
    fisheye = str(data.get("StereoRectifier.model", "perspective")).lower() == "fisheye"
    p = [fx, 0.0, cx, shift, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return info_from_rows(*size, "fisheye" if fisheye else "plumb_bob", k, d, r, p)
