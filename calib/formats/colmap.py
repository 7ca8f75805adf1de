"""COLMAP text models: `cameras.txt` and, since 3.12, `rigs.txt` with the cameras' poses.

COLMAP puts the centre of the first pixel at (0.5, 0.5), so its principal point is ours plus half a pixel, and
`sensor_from_rig` is the inverse of our camera pose in the rig.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stereo_sfm.calib.formats.common import brown, numbers, padded, read_text, reading, unsupported
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, Fov, KannalaBrandt
from stereo_sfm.types import F64

# model -> (number of focal lengths, names of the coefficients in OpenCV's order, None where COLMAP has none)
_BROWN_MODELS: dict[str, tuple[int, tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": (1, ()),
    "PINHOLE": (2, ()),
    "SIMPLE_RADIAL": (1, (0,)),
    "RADIAL": (1, (0, 1)),
    "OPENCV": (2, (0, 1, 2, 3)),
    "FULL_OPENCV": (2, (0, 1, 2, 3, 4, 5, 6, 7)),
}


def colmap_camera(model: str, width: int, height: int, params: list[float], shift: float = 0.5) -> Camera:
    """A camera from COLMAP's model name and parameters; `shift` px is subtracted from the principal point."""
    if model == "OPENCV_FISHEYE":
        fx, fy, cx, cy, *k = numbers(params, 8)
        return KannalaBrandt(width, height, fx, fy, cx - shift, cy - shift, tuple(k))
    if model == "FOV":
        fx, fy, cx, cy, w = numbers(params, 5)
        return Fov.published(width, height, fx, fy, cx - shift, cy - shift, (w,))
    if model not in _BROWN_MODELS:
        raise ValueError(
            f"camera model '{model}' is not supported (supported: {', '.join(_BROWN_MODELS)}, OPENCV_FISHEYE, FOV)"
        )
    focals, slots = _BROWN_MODELS[model]
    values = numbers(params, focals + 2 + len(slots))
    focal = (values[0], values[focals - 1])
    cx, cy, *coefficients = values[focals:]
    return brown((width, height), focal, (cx - shift, cy - shift), coefficients)


def colmap_params(camera: Camera, shift: float = 0.5) -> tuple[str, list[float]]:
    """COLMAP's model name and parameters of a camera."""
    base = [float(v) for v in (*camera.published_focal, camera.cx + shift, camera.cy + shift)]
    if camera.model == "kannala_brandt":
        return "OPENCV_FISHEYE", base + padded(camera, 4)
    if camera.model == "pinhole":
        return "PINHOLE", base
    if camera.model == "radtan":
        small = len(camera.distortion) <= 4
        return ("OPENCV", base + padded(camera, 4)) if small else ("FULL_OPENCV", base + padded(camera, 8))
    if camera.model == "fov":
        return "FOV", base + padded(camera, 1)
    raise unsupported(camera, "COLMAP")


def read_colmap(path: Path | str) -> Rig:
    """A model folder or its cameras.txt; two cameras need `rigs.txt` beside it for the extrinsics."""
    path = Path(path)
    path = path / "cameras.txt" if path.is_dir() else path
    with reading(path, "COLMAP"):
        cameras = {
            int(f[0]): colmap_camera(f[1], int(f[2]), int(f[3]), [float(v) for v in f[4:]]) for f in _lines(path)
        }
        if len(cameras) == 1:
            return Rig(next(iter(cameras.values())), name=path.parent.name)
        rigs = path.with_name("rigs.txt")
        if len(cameras) != 2 or not rigs.is_file():
            raise StereoSfmError(
                f"COLMAP calibration {path} has {len(cameras)} cameras and no rigs.txt: the extrinsics are missing"
            )
        reference, other, other_T_reference = _rig(rigs)
        return Rig(cameras[reference], cameras[other], se3.inverse(other_T_reference), name=path.parent.name)


def write_colmap(rig: Rig, folder: Path) -> None:
    """`cameras.txt` and `rigs.txt`. The body's pose is not stored."""
    write_colmap_rigs([rig], folder)


def write_colmap_rigs(rigs: Sequence[Rig], folder: Path) -> None:
    """Write several rigs, numbered from 1 in this order; their cameras follow each other, left before right."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras: list[Camera] = []
    entries = ["# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as (TYPE, ID, HAS_POSE, [QW..TZ])"]
    for number, rig in enumerate(rigs, 1):
        left = len(cameras) + 1
        cameras += [rig.left] if rig.right is None else [rig.left, rig.right]
        if rig.right is None:
            entries.append(f"{number} 1 CAMERA {left}")
            continue
        right_T_left = se3.inverse(rig.left_T_right)
        x, y, z, w = se3.quaternion_from_rotation(right_T_left[:3, :3])
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *right_T_left[:3, 3]))
        entries.append(f"{number} 2 CAMERA {left} CAMERA {left + 1} 1 {pose}")
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for i, camera in enumerate(cameras, 1):
        model, params = colmap_params(camera)
        lines.append(f"{i} {model} {camera.width} {camera.height} " + " ".join(map(repr, params)))
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "rigs.txt").write_text("\n".join(entries) + "\n", encoding="utf-8")


def _lines(path: Path) -> list[list[str]]:
    return [line.split() for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]


def _rig(path: Path) -> tuple[int, int, F64]:
    """Reference camera, other camera, other_T_reference (4, 4)."""
    fields = _lines(path)[0]
    if fields[1] != "2" or fields[2] != "CAMERA" or fields[4] != "CAMERA" or fields[6] != "1":
        raise ValueError("rigs.txt does not describe two cameras with a pose")
    w, x, y, z, *translation = numbers(fields[7:14], 7)
    rotation = se3.rotation_from_quaternion(np.array([x, y, z, w]))
    return int(fields[3]), int(fields[5]), se3.from_rotation_translation(rotation, np.array(translation))
