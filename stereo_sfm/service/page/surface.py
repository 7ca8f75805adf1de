"""The picture from above of a surface that `dense` made of the saved map, in the axes of the poses."""

from __future__ import annotations

import threading
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stereo_sfm.export.floor_plan import turned
from stereo_sfm.input_file import read_bytes, read_yaml
from stereo_sfm.service.outputs.robot_axes import RobotAxes
from stereo_sfm.types import U8

PICTURE, ABOUT = "height.png", "costmap.yaml"  # both have the same pixels
MOST_PX = 2048  # a side: more takes long on a telephone


@dataclass(frozen=True)
class SurfacePicture:
    """PNG, x up and y to the left, and where it lies: metres in the robot's map as of the floor plan."""

    png: bytes
    extent: dict[str, float | str]


class SurfacePictures:
    """The newest picture in a folder, read again when it was written again, or lies in other axes."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._lock = folder, threading.Lock()
        self._made_of = ""  # version: when the picture was written, and the axes
        self._newest: SurfacePicture | None = None

    def newest(self, axes: RobotAxes) -> SurfacePicture | None:
        """The picture; None where there is none that can be read."""
        with self._lock:
            try:
                written = (self._folder / PICTURE).stat().st_mtime_ns
                version = f"{written}-{zlib.crc32(axes.base_T_left.tobytes())}"
                if version != self._made_of:
                    self._made_of, self._newest = version, None
                    self._newest = self._made(axes, version)
            except (OSError, ValueError, LookupError, TypeError, cv2.error):
                return None
            return self._newest

    def _made(self, axes: RobotAxes, version: str) -> SurfacePicture | None:
        image = cv2.imdecode(np.frombuffer(read_bytes(self._folder / PICTURE), np.uint8), cv2.IMREAD_UNCHANGED)
        about = read_yaml(self._folder / ABOUT)
        if image is None or image.ndim != 3 or image.shape[2] != 4:
            return None
        step = -(-max(image.shape[:2]) // MOST_PX)
        some: U8 = np.ascontiguousarray(image[::-1][::step, ::step][::-1], np.uint8)
        resolution, origin = step * float(about["resolution"]), (float(about["origin"][0]), float(about["origin"][1]))
        map_T_floor = axes.in_map(np.array(about["map_T_floor"], float).reshape(4, 4))
        flat, corner = turned(some, resolution, origin, map_T_floor, 0)
        along_y, along_x = flat.shape[0] * resolution, flat.shape[1] * resolution
        x, y = float(corner[0]) + along_x, float(corner[1]) + along_y
        png = cv2.imencode(".png", flat.transpose(1, 0, 2)[::-1, ::-1])[1].tobytes()
        extent: dict[str, float | str] = {
            "version": version,
            "x": x,
            "y": y,
            "along_x": along_x,
            "along_y": along_y,
        }
        return SurfacePicture(png, extent)
