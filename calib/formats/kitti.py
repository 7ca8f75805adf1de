"""KITTI: `calib.txt` of the odometry benchmark and `calib_cam_to_cam.txt` of the raw data; rectified pinhole pairs."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np

from stereo_sfm.calib.formats.common import numbers, read_text, reading, stereo_only
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.input_file import read_bytes, visible
from stereo_sfm.types import F64


def read_kitti(path: Path | str, size: tuple[int, int] | None = None, pair: tuple[int, int] = (0, 1)) -> Rig:
    """The rectified cameras `pair` (grey cameras 0 and 1, colour cameras 2 and 3).

    Args:
        path: calib.txt, calib_cam_to_cam.txt, or the folder that holds one of them.
        size: (width, height) px; default: as stated in the file, else that of the first image next to it.
    """
    path = Path(path)
    if path.is_dir():
        path = next(
            (path / n for n in ("calib.txt", "calib_cam_to_cam.txt") if (path / n).is_file()), path / "calib.txt"
        )
    with reading(path, "KITTI"):
        entries = _entries(path)
        cameras = [_projection(entries, i) for i in pair]
        width, height = size or _size(path, entries, pair[0])
        (k_left, t_left), (k_right, t_right) = cameras
        left, right = (Pinhole(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2]) for k in (k_left, k_right))
        # p_camera_i = p_reference + t_i for every camera of the rectified rig.
        return Rig(
            left,
            right,
            se3.from_rotation_translation(np.eye(3), t_left - t_right),
            se3.from_rotation_translation(np.eye(3), -t_left),
            name="kitti",
        )


def write_kitti(rig: Rig, path: Path) -> None:
    """calib.txt with P0 and P1, and the image size under the raw data's key."""
    right = stereo_only(rig.right, "KITTI")
    t = rig.left_T_right[:3, 3]
    tilted = not np.allclose(rig.left_T_right[:3, :3], np.eye(3), atol=1e-12)
    if rig.left.model != "pinhole" or right.model != "pinhole" or tilted:
        raise StereoSfmError("KITTI's calib.txt stores rectified pinhole pairs only: rectify first")
    lines: list[str] = []
    for i, (camera, offset) in enumerate(((rig.left, np.zeros(3)), (right, -t))):
        projection = camera.matrix @ np.column_stack([np.eye(3), offset])
        lines.append(f"P{i}: " + " ".join(f"{v:.17g}" for v in projection.ravel()))
        lines.append(f"S_rect_{i:02d}: {camera.width} {camera.height}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _entries(path: Path) -> dict[str, list[float]]:
    out: dict[str, list[float]] = {}
    for line in read_text(path).splitlines():
        key, colon, values = line.partition(":")
        if colon:
            try:
                out[key.strip()] = [float(v) for v in values.split()]
            except ValueError:
                continue  # dates and comments
    return out


def _projection(entries: dict[str, list[float]], index: int) -> tuple[F64, F64]:
    """K (3, 3) and the translation (3,) from the reference camera."""
    key = f"P_rect_{index:02d}" if f"P_rect_{index:02d}" in entries else f"P{index}"
    p = np.array(numbers(entries[key], 12)).reshape(3, 4)
    return p[:, :3], np.linalg.solve(p[:, :3], p[:, 3])


def _size(path: Path, entries: dict[str, list[float]], index: int) -> tuple[int, int]:
    stated = entries.get(f"S_rect_{index:02d}")
    if stated:
        width, height = numbers(stated, 2)
        return int(width), int(height)
    folders = (path.parent / f"image_{index}", path.parent / f"image_{index:02d}" / "data")
    from stereo_sfm.pixels import SUFFIXES, declared_size

    for folder in filter(Path.is_dir, folders):
        for image in sorted(p for p in visible(folder) if p.suffix.lower() in SUFFIXES)[:20]:
            with suppress(ValueError, OSError):
                return declared_size(read_bytes(image))
    raise ValueError("no image size stated, and no readable image next to the file")
