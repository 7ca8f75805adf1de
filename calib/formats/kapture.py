"""kapture's `sensors.txt` and `rigs.txt`: COLMAP's model names, poses as sensor_from_rig, comma separated.

The principal point is read unchanged: kapture copies what the device or the tool before it reported.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereo_sfm.calib.formats.colmap import colmap_camera, colmap_params
from stereo_sfm.calib.formats.common import numbers, read_text, reading
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import F64


def read_kapture(path: Path | str, left_T_right: F64 | None = None) -> Rig:
    """The first two cameras of a sensors file.

    Args:
        path: sensors.txt, or a folder that holds it (or `sensors/sensors.txt`).
        left_T_right: (4, 4) extrinsics where the data set has no rigs.txt.

    Raises:
        StereoSfmError: no camera, malformed, or two cameras without extrinsics.
    """
    path = Path(path)
    if path.is_dir():
        path = (
            path / "sensors" / "sensors.txt" if (path / "sensors" / "sensors.txt").is_file() else path / "sensors.txt"
        )
    with reading(path, "kapture"):
        cameras = read_kapture_cameras(path)
        (left_id, left), *others = cameras.items()
        if not others:
            return Rig(left, name=path.parent.name)
        right_id, right = others[0]
        rigs = path.with_name("rigs.txt")
        if left_T_right is not None:
            return Rig(left, right, left_T_right, name=path.parent.name)
        if not rigs.is_file():
            raise ValueError("it has two cameras but there is no rigs.txt: the extrinsics are missing")
        poses = _rig_poses(rigs)
        left_T_right = poses[left_id] @ se3.inverse(poses[right_id])
        return Rig(left, right, left_T_right, se3.inverse(poses[left_id]), name=path.parent.name)


def read_kapture_cameras(path: Path) -> dict[str, Camera]:
    """Every camera of a sensors file by its id, in the file's order."""
    cameras: dict[str, Camera] = {}
    with reading(path, "kapture"):
        for fields in _lines(path):
            if fields[2] == "camera":
                params = [float(v) for v in fields[6:]]
                cameras[fields[0]] = colmap_camera(fields[3], int(fields[4]), int(fields[5]), params, shift=0.0)
        if not cameras:
            raise ValueError("no camera listed")
    return cameras


def write_kapture(rig: Rig, folder: Path) -> None:
    """`sensors.txt` and `rigs.txt`, the rig's origin being the body."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras = [("cam0", rig.left, se3.inverse(rig.body_T_left))]
    if rig.right is not None:
        cameras.append(("cam1", rig.right, se3.inverse(rig.body_T_left @ rig.left_T_right)))
    sensors = ["# kapture format: 1.1", "# sensor_id, name, sensor_type, [sensor_params]+"]
    rigs = ["# kapture format: 1.1", "# rig_id, sensor_id, qw, qx, qy, qz, tx, ty, tz"]
    for name, camera, cam_T_body in cameras:
        model, params = colmap_params(camera, shift=0.0)
        sensors.append(f"{name}, , camera, {model}, {camera.width}, {camera.height}, " + ", ".join(map(repr, params)))
        x, y, z, w = se3.quaternion_from_rotation(cam_T_body[:3, :3])
        pose = ", ".join(repr(float(v)) for v in (w, x, y, z, *cam_T_body[:3, 3]))
        rigs.append(f"rig, {name}, {pose}")
    (folder / "sensors.txt").write_text("\n".join(sensors) + "\n", encoding="utf-8")
    (folder / "rigs.txt").write_text("\n".join(rigs) + "\n", encoding="utf-8")


def _lines(path: Path) -> list[list[str]]:
    text = read_text(path).splitlines()
    return [[f.strip() for f in line.split(",")] for line in text if line.strip() and not line.startswith("#")]


def _rig_poses(path: Path) -> dict[str, F64]:
    """sensor id -> sensor_T_rig (4, 4)."""
    poses: dict[str, F64] = {}
    for fields in _lines(path):
        w, x, y, z, *translation = numbers([float(v) for v in fields[2:9]], 7)
        rotation = se3.rotation_from_quaternion(np.array([x, y, z, w]))
        poses[fields[1]] = se3.from_rotation_translation(rotation, np.array(translation))
    return poses
