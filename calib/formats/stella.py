"""Settings files of stella_vslam and OpenVSLAM, as calibrations. Only read.

`Camera` holds the camera after rectification with `focal_x_baseline`; `StereoRectifier` the original ones, if the
images are not rectified.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stereo_sfm.calib.formats.camera_info import CameraInfo, info_from_rows, rig_from_infos
from stereo_sfm.calib.formats.common import numbers, reading
from stereo_sfm.calib.formats.settings_files import Lenses, read_flat, rectified_pair
from stereo_sfm.calib.rig import Rig

_LENSES = Lenses("Camera.model", {"perspective": False, "fisheye": True}, ("Camera.cols", "Camera.rows"))


def read_stella(path: Path | str, size: tuple[int, int] | None = None, unit: float = 1.0) -> Rig:
    """One camera or a stereo pair.

    Args:
        path: the file. size: (width, height) px where it states none. unit: of lengths, in metres.
    """
    path = Path(path)
    with reading(path, "stella_vslam"):
        data = read_flat(path)
        left = _LENSES.of(data, size, "Camera.")  # of the rectified images, if any
        if str(data.get("Camera.setup", "monocular")).lower() != "stereo":
            return Rig(left, name=path.stem)
        if "StereoRectifier.K_left" in data:
            first, second = (_info(data, side, left.size) for side in ("left", "right"))
            return rig_from_infos(first, second, path.stem, unit=unit)
        return rectified_pair(left, unit * float(data["Camera.focal_x_baseline"]) / left.fx, path.stem)


def _info(data: dict[str, Any], side: str, size: tuple[int, int]) -> CameraInfo:
    k, d, r = (numbers(data[f"StereoRectifier.{key}_{side}"]) for key in "KDR")
    fx, fy, cx, cy = numbers([data[f"Camera.{name}"] for name in ("fx", "fy", "cx", "cy")])
    shift = 0.0 if side == "left" else -float(data["Camera.focal_x_baseline"])
    fisheye = str(data.get("StereoRectifier.model", "perspective")).lower() == "fisheye"
    p = [fx, 0.0, cx, shift, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return info_from_rows(*size, "fisheye" if fisheye else "plumb_bob", k, d, r, p)
