"""kapture folders: the T265 samples (`kapture_sensors.txt`, fisheye1/, fisheye2/) and the full layout (`sensors/`).

Format: github.com/naver/kapture, version 1.1. A rig line `rig, sensor, qw, qx, qy, qz, tx, ty, tz` is sensor_T_rig.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from calib.rig import Rig
from drivers.folder_source import FolderSource, Shot, folder_of, list_images, need, pair_by_stamp
from drivers.rig_option import RigOption, chosen_rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole, RadTan
from stereo_sfm.types import F64

log = logging.getLogger("stereo_sfm")

MAX_SKEW_NS = 3_000_000
T265_BASELINE = 0.064  # metres, the nominal distance of a T265's eyes
Listing = list[tuple[int, Path]]


def open_kapture(path: str, rig: RigOption = None) -> FolderSource:
    """Open the first two cameras of a kapture folder."""
    folder = folder_of("kapture", path)
    name = f"kapture:{folder.resolve().name}"
    sample = folder / "kapture_sensors.txt"
    sensors = sample if sample.is_file() else need(folder / "sensors" / "sensors.txt", "kapture sensors")
    cameras = _read_cameras(sensors)
    if len(cameras) < 2:
        raise StereoSfmError(f"{sensors} holds {len(cameras)} camera, two are needed")
    ids = list(cameras)[:2]
    left, right = _listings(folder, ids)
    pairs = pair_by_stamp([s for s, _ in left], [s for s, _ in right], MAX_SKEW_NS)
    if len(pairs) < max(len(left), len(right)):
        log.warning("%s: %d left and %d right images, the %d pairs are used", name, len(left), len(right), len(pairs))
    shots = [Shot(left[i][0], left[i][1], right[j][1]) for i, j in pairs]
    return FolderSource(name, chosen_rig(rig, lambda: _read_rig(folder, cameras, ids)), shots)


def _rows(path: Path) -> list[list[str]]:
    lines = path.read_text().splitlines()
    return [[f.strip() for f in line.split(",")] for line in lines if line.strip() and not line.startswith("#")]


def _read_cameras(path: Path) -> dict[str, Camera]:
    """Sensor id -> camera, in the order of the file."""
    cameras: dict[str, Camera] = {}
    for row in _rows(path):
        if len(row) > 3 and row[2] == "camera":
            try:
                cameras[row[0]] = _camera(row[3], [float(v) for v in row[4:]])
            except (ValueError, IndexError, TypeError):
                raise StereoSfmError(f"{path}: camera {row[0]} ({row[3]}) is malformed") from None
    return cameras


def _camera(model: str, p: list[float]) -> Camera:
    """COLMAP's model names: width, height, then fx fy cx cy and coefficients."""
    width, height = int(p[0]), int(p[1])
    if model == "OPENCV_FISHEYE":
        fx, fy, cx, cy, *distortion = p[2:10]
        return KannalaBrandt(width, height, fx, fy, cx, cy, tuple(distortion))
    if model in ("OPENCV", "FULL_OPENCV"):
        fx, fy, cx, cy, *distortion = p[2:]
        return RadTan(width, height, fx, fy, cx, cy, tuple(distortion))
    if model == "PINHOLE":
        return Pinhole(width, height, p[2], p[3], p[4], p[5])
    if model == "SIMPLE_PINHOLE":
        return Pinhole(width, height, p[2], p[2], p[3], p[4])
    raise StereoSfmError(f"kapture camera model {model} is not supported (OPENCV_FISHEYE, OPENCV, PINHOLE are)")


def _listings(folder: Path, ids: list[str]) -> tuple[Listing, Listing]:
    """(stamp_ns, file) of both eyes."""
    records = folder / "sensors" / "records_camera.txt"
    if not records.is_file():
        left, right = (_by_file_name(folder / f"fisheye{i}") for i in (1, 2))
        return left, right
    eyes: dict[str, Listing] = {i: [] for i in ids}
    for row in _rows(records):
        if row[1] in eyes:
            eyes[row[1]].append((_stamp(row[0]), folder / "sensors" / "records_data" / row[2]))
    return eyes[ids[0]], eyes[ids[1]]


def _by_file_name(folder: Path) -> Listing:
    return [(_stamp(p.stem), p) for p in list_images(folder)]


def _stamp(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise StereoSfmError(f"kapture: '{text}' is not a stamp in nanoseconds") from None


def _read_rig(folder: Path, cameras: dict[str, Camera], ids: list[str]) -> Rig:
    left, right = (cameras[i] for i in ids)
    poses = _read_rig_poses(folder / "sensors" / "rigs.txt")
    if all(i in poses for i in ids):
        left_T_right = poses[ids[0]] @ se3.inverse(poses[ids[1]])
        return Rig(left, right, left_T_right, se3.inverse(poses[ids[0]]), name="kapture")
    if not all(isinstance(c, KannalaBrandt) and c.size == (848, 800) for c in (left, right)):
        raise StereoSfmError(f"{folder} does not say where the cameras sit (sensors/rigs.txt): give --rig FILE")
    log.warning("%s: no extrinsics, the T265's nominal %g m between parallel eyes are used", folder, T265_BASELINE)
    left_T_right = np.eye(4)
    left_T_right[0, 3] = T265_BASELINE
    return Rig(left, right, left_T_right, name="T265 nominal")


def _read_rig_poses(path: Path) -> dict[str, F64]:
    """Sensor id -> sensor_T_rig."""
    poses: dict[str, F64] = {}
    for row in _rows(path) if path.is_file() else []:
        try:
            qw, qx, qy, qz, *t = (float(v) for v in row[2:9])
        except ValueError:
            raise StereoSfmError(f"{path}: sensor {row[1]} is malformed") from None
        rotation = se3.rotation_from_quaternion(np.array([qx, qy, qz, qw]))
        poses[row[1]] = se3.from_rotation_translation(rotation, np.array(t))
    return poses
