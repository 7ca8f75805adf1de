"""OpenCV FileStorage (.yml, .xml, .json): M1 D1 M2 D2 R T as cv2.stereoCalibrate returns them, right_T_left = [R T]."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import (
    brown,
    exact_rotation,
    no_other_distortion,
    numbers,
    padded,
    reading,
    unsupported,
)
from stereo_sfm.calib.formats.file_storage import matrix, read_storage
from stereo_sfm.calib.lens_doubts import believable
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole, RadTan
from stereo_sfm.types import F64

_NAMES: dict[str, tuple[str, ...]] = {  # our name -> common spellings
    "M1": ("M1", "K1", "cameraMatrix1", "camera_matrix_left", "cameraMatrixL", "camera_matrix", "cameraMatrix"),
    "M2": ("M2", "K2", "cameraMatrix2", "camera_matrix_right", "cameraMatrixR"),
    "D1": (
        "D1",
        "distCoeffs1",
        "dist_coeffs_left",
        "distortion_coefficients_left",
        "distCoeffsL",
        "distortion_coefficients",
        "distCoeffs",
        "dist_coeffs",
        "dist_coeff",
    ),
    "D2": ("D2", "distCoeffs2", "dist_coeffs_right", "distortion_coefficients_right", "distCoeffsR"),
    "R": ("R", "rotation"),
    "T": ("T", "translation"),
}


def read_opencv(path: Path | str, size: tuple[int, int] | None = None, lens: str = "", unit: float = 1.0) -> Rig:
    """One file, or `intrinsics.yml` with `extrinsics.yml` next to it as written by OpenCV's stereo sample.

    Four coefficients with `distortion_model: fisheye` (or equidistant) are Kannala-Brandt, all others Brown's.

    Args:
        path: the file. size: (width, height) px where it states none.
        lens: the lens model's name instead of the file's. unit: of T, in metres (the squares' size of a target).
    """
    path = Path(path)
    with reading(path, "OpenCV"):
        data = _matrices(path)
        extrinsics = path.parent / path.name.replace("intrinsics", "extrinsics")
        if "R" not in data and extrinsics != path and extrinsics.is_file():
            data |= {k: v for k, v in _matrices(extrinsics).items() if k in ("R", "T")}
        if size is None and "size" not in data:
            raise ValueError(
                "no image size stated (image_width, image_height): give it, as convert-calib's --size WxH does"
            )
        width, height = size or numbers(data["size"], 2)
        named = lens or data.get("model") or ""
        fisheye = named in ("fisheye", "equidistant", "kannala_brandt")
        sides = [side for side in "12" if f"M{side}" in data] or ["1"]
        cameras = [
            _camera(data[f"M{side}"], data.get(f"D{side}", []), (int(width), int(height)), fisheye) for side in sides
        ]
        if not named:
            cameras = believable(cameras, str(path))
        if len(cameras) == 1:
            return Rig(cameras[0], name=path.stem)
        left, right = cameras
        right_T_left = np.eye(4)
        right_T_left[:3, :3] = np.array(numbers(data["R"], 9)).reshape(3, 3)
        right_T_left[:3, 3] = unit * np.array(numbers(data.get("T", []), 3))
        return Rig(left, right, se3.inverse(exact_rotation(right_T_left)), name=path.stem)


def write_opencv(rig: Rig, path: Path) -> None:
    """M1 D1 M2 D2 R T, the image size, the distortion model."""
    import cv2

    cameras = [rig.left] if rig.right is None else [rig.left, rig.right]
    if len({_model(camera) for camera in cameras}) > 1:
        raise unsupported(cameras[1], "OpenCV with two lens models")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if not storage.isOpened():
        raise OSError(0, "not a writable file")
    try:
        storage.write("image_width", rig.left.width)
        storage.write("image_height", rig.left.height)
        storage.write("distortion_model", _model(rig.left))
        for i, camera in enumerate(cameras, 1):
            count = next(n for n in (4, 8, 14) if n >= len(camera.distortion))
            storage.write(f"M{i}", camera.matrix)
            storage.write(f"D{i}", np.array([padded(camera, count)]))
        if rig.right is not None:
            right_T_left = se3.inverse(rig.left_T_right)
            storage.write("R", right_T_left[:3, :3])
            storage.write("T", right_T_left[:3, 3:])
    finally:
        storage.release()


def _model(camera: Camera) -> str:
    if camera.model == "kannala_brandt":
        return "fisheye"
    if not isinstance(camera, Pinhole | RadTan):
        raise unsupported(camera, "OpenCV")
    return "plumb_bob"


def _matrices(path: Path) -> dict[str, Any]:
    """Numbers by our names, with `size` and `model` where the file has them."""
    storage = read_storage(path)
    data: dict[str, Any] = {}
    for ours, names in _NAMES.items():
        found = next((m for m in map(matrix, map(storage.get, names)) if m is not None), None)
        if found is not None:
            data[ours] = found
    sizes = [[storage.get("image_width"), storage.get("image_height")]]
    sizes += [storage.get(name) for name in ("image_size", "imageSize", "size")]
    size = next((s for s in sizes if isinstance(s, list) and len(s) == 2 and None not in s), None)
    if size is not None:
        data["size"] = numbers(size, 2)
    data["model"] = storage.get("distortion_model")
    if "D1" not in data and "M1" in data:
        no_other_distortion(storage, "D1")
    if len(data.get("R", [])) == 3:
        data["R"] = se3.so3_exp(np.array(data["R"])).ravel()
    return data


def _camera(matrix: F64, coefficients: Any, size: tuple[int, int], fisheye: bool) -> Camera:
    k = np.array(numbers(matrix, 9)).reshape(3, 3)
    d = numbers(coefficients)
    if fisheye:
        return KannalaBrandt(*size, k[0, 0], k[1, 1], k[0, 2], k[1, 2], tuple(numbers(d, 4)))
    return brown(size, (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2]), d)
