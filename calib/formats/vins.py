"""Settings files of VINS-Fusion and VINS-Mono, and camodocal's camera files that they name. Only read.

`body_T_cam0` takes points of the camera into the IMU, which is the body. The noise of these files is tuned, and of a
sample instead of a density: it is not read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import brown, numbers, reading, rigid
from stereo_sfm.calib.formats.settings_files import read_flat
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Mei
from stereo_sfm.types import F64

_BROWN = ("k1", "k2", "p1", "p2")
# model -> names of the focal lengths and the centre, which stand with the projection's parameters
_FOCAL = {
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "MEI": ("gamma1", "gamma2", "u0", "v0"),
    "KANNALA_BRANDT": ("mu", "mv", "u0", "v0"),
}


def read_vins(path: Path | str, unit: float = 1.0) -> Rig:
    """The cameras that a settings file names, or one camera file alone; `unit`: of lengths, in metres."""
    path = Path(path)
    with reading(path, "VINS"):
        data = read_flat(path)
        files = [path.with_name(str(data[key])) for key in ("cam0_calib", "cam1_calib") if key in data]
        if "num_of_cam" in data:
            files = files[: int(data["num_of_cam"])]
        cameras = [_camera(read_flat(file)) for file in files] or [_camera(data)]
        poses = [_pose(data, k, unit) for k in range(len(cameras))]
        body_T_left = np.eye(4) if poses[0] is None else poses[0]
        imu = None
        if poses[0] is not None and int(data.get("imu", 1)):
            imu = Imu(se3.inverse(body_T_left), offset_s=float(data.get("td", 0.0)))
        if len(cameras) == 1:
            return Rig(cameras[0], body_T_left=body_T_left, imu=imu, name=path.stem)
        if poses[0] is None or poses[1] is None:
            raise KeyError("body_T_cam1")
        return Rig(cameras[0], cameras[1], se3.inverse(poses[0]) @ poses[1], body_T_left, imu=imu, name=path.stem)


def _pose(data: dict[str, Any], camera: int, unit: float) -> F64 | None:
    """body_T_camera (4, 4); VINS-Mono states its rotation and translation apart."""
    if f"body_T_cam{camera}" in data:
        return rigid(data[f"body_T_cam{camera}"], unit)
    if camera or "extrinsicRotation" not in data:
        return None
    rotation = np.reshape(numbers(data["extrinsicRotation"], 9), (3, 3))
    return rigid(np.column_stack([rotation, numbers(data["extrinsicTranslation"], 3)]).ravel().tolist(), unit)


def _camera(data: dict[str, Any]) -> Camera:
    kind = str(data["model_type"]).upper()
    if kind not in _FOCAL:
        raise ValueError(f"camera model '{kind}' is not supported (supported: {', '.join(_FOCAL)})")
    size = int(data["image_width"]), int(data["image_height"])
    fx, fy, cx, cy = numbers([data[f"projection_parameters.{name}"] for name in _FOCAL[kind]])
    if kind == "KANNALA_BRANDT":  # theta^3 has k2
        k = numbers([data[f"projection_parameters.k{n}"] for n in (2, 3, 4, 5)])
        return KannalaBrandt(*size, fx, fy, cx, cy, tuple(k))
    coefficients = numbers([data[f"distortion_parameters.{name}"] for name in _BROWN])
    if kind == "MEI":
        return Mei.published(*size, fx, fy, cx, cy, (float(data["mirror_parameters.xi"]), *coefficients))
    return brown(size, (fx, fy), (cx, cy), coefficients)
