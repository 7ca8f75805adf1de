"""EuRoC / ASL folders: `mav0/cam0/sensor.yaml`, `mav0/cam1/sensor.yaml`. `T_BS` is body_T_camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stereo_sfm.calib.formats.common import brown, numbers, padded, read_yaml, reading, rigid, unsupported, write_yaml
from stereo_sfm.calib.formats.imu_files import read_imu, write_euroc_imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole, RadTan
from stereo_sfm.types import F64


def read_euroc(folder: Path | str, unit: float = 1.0) -> Rig:
    """The dataset's root, its `mav0`, or any folder that holds `cam0/sensor.yaml`; one camera when there is no cam1.

    `unit`: of lengths, in metres.
    """
    folder = Path(folder)
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    left, body_T_left = _sensor(root / "cam0" / "sensor.yaml", unit)
    left_T_body, file = se3.inverse(body_T_left), root / "imu0" / "sensor.yaml"
    imu = read_imu(file, left_T_body) if file.is_file() else None
    if not (root / "cam1" / "sensor.yaml").is_file():
        return Rig(left, body_T_left=body_T_left, imu=imu, name=folder.name)
    right, body_T_right = _sensor(root / "cam1" / "sensor.yaml", unit)
    return Rig(left, right, left_T_body @ body_T_right, body_T_left, imu=imu, name=folder.name)


def write_euroc(rig: Rig, folder: Path) -> None:
    """`folder/cam0/sensor.yaml`, `cam1` and `imu0`."""
    cameras = [(rig.left, rig.body_T_left)]
    if rig.right is not None:
        cameras.append((rig.right, rig.body_T_left @ rig.left_T_right))
    for i, (camera, body_T_cam) in enumerate(cameras):
        target = folder / f"cam{i}" / "sensor.yaml"
        target.parent.mkdir(parents=True, exist_ok=True)
        write_yaml(target, _plain(camera, body_T_cam, i))
    if rig.imu is not None:
        (folder / "imu0").mkdir(exist_ok=True)
        write_euroc_imu(rig.imu, rig.body_T_left @ rig.imu.left_T_imu, folder / "imu0" / "sensor.yaml")


def _sensor(path: Path, unit: float) -> tuple[Camera, F64]:
    with reading(path, "EuRoC"):
        data = read_yaml(path)
        size = [int(v) for v in numbers(data["resolution"], 2)]
        fx, fy, cx, cy = numbers(data["intrinsics"], 4)
        model = data["distortion_model"]
        coefficients = numbers(data.get("distortion_coefficients", []))
        body_T_cam = rigid(data["T_BS"]["data"], unit)
        if model == "equidistant":
            camera = KannalaBrandt(size[0], size[1], fx, fy, cx, cy, tuple(numbers(coefficients, 4)))
        elif model in ("radial-tangential", "radtan", "none"):
            camera = brown(size, (fx, fy), (cx, cy), coefficients)
        else:
            raise ValueError(f"distortion model '{model}' is not supported")
        return camera, body_T_cam


def _plain(camera: Camera, body_T_cam: F64, index: int) -> dict[str, Any]:
    if not isinstance(camera, Pinhole | RadTan | KannalaBrandt):
        raise unsupported(camera, "EuRoC")
    if len(camera.distortion) > 4:
        raise StereoSfmError(
            "EuRoC's sensor.yaml stores four coefficients, this camera has more: use the format opencv, ros or rig"
        )
    name = "equidistant" if camera.model == "kannala_brandt" else "radial-tangential"
    return {
        "sensor_type": "camera",
        "comment": f"cam{index}",
        "T_BS": {"cols": 4, "rows": 4, "data": [float(v) for v in body_T_cam.ravel()]},
        "resolution": [camera.width, camera.height],
        "camera_model": "pinhole",
        "intrinsics": [float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)],
        "distortion_model": name,
        "distortion_coefficients": padded(camera, 4),
    }
