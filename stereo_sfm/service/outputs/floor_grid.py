"""The floor plan of the saved map, made in a process of its own whenever the map has been saved."""

from __future__ import annotations

import logging
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.floor_plan import FREE, OCCUPIED, UNKNOWN
from stereo_sfm.geometry import se3
from stereo_sfm.service.messages import Status
from stereo_sfm.service.outputs.background import run_command
from stereo_sfm.types import F64, U8

log = logging.getLogger("stereo_sfm")

LONGEST_S = 120.0
RawPlan = tuple[U8, float, tuple[float, float], F64]  # the arguments of `aligned`, in the left camera's axes
CELLS: dict[int, int] = {FREE: 0, OCCUPIED: 100, UNKNOWN: -1}  # of nav_msgs/OccupancyGrid


@dataclass(frozen=True, eq=False)
class FloorGrid:
    """A grid whose rows lie along x and whose columns lie along y of the robot's map."""

    cells: np.ndarray[Any, np.dtype[np.int8]]  # (H, W) 0 free, 100 occupied, -1 unknown; row 0 has the least y
    resolution: float  # metres
    origin: F64  # (3,) of the corner with the least x and y, in the map


def aligned(image: U8, resolution: float, origin: tuple[float, float], map_T_floor: F64) -> FloorGrid:
    """Turn a floor plan into the axes of the map: Nav2 takes no grid that is turned.

    Args:
        image: (H, W) FREE, OCCUPIED, UNKNOWN; the rest as `turned`.
    """
    flat, start = turned(image, resolution, origin, map_T_floor, UNKNOWN)
    cells = np.full(flat.shape, -1, np.int8)
    for grey, value in CELLS.items():
        cells[flat == grey] = value
    return FloorGrid(cells, resolution, start)


def turned(image: U8, resolution: float, origin: tuple[float, float], map_T_floor: F64, border: int) -> tuple[U8, F64]:
    """A picture from above in the axes of the map, the first row with the least y; its corner with the least x and y.

    Args:
        image: (H, W) or (H, W, C); the last row has the least y.
        resolution: metres per pixel.
        origin: metres, corner with the least x and y in the floor's frame.
        map_T_floor: (4, 4) the floor in the robot's map.
        border: around it.
    """
    height, width = image.shape[:2]
    size = np.array([width, height]) * resolution
    corners = np.array([[origin[0] + x, origin[1] + y, 0.0] for x in (0.0, size[0]) for y in (0.0, size[1])])
    outline = se3.transform(map_T_floor, corners)
    low = np.floor(outline[:, :2].min(0) / resolution) * resolution
    columns, rows = np.ceil((outline[:, :2].max(0) - low) / resolution).astype(int)
    yaw = np.arctan2(map_T_floor[1, 0], map_T_floor[0, 0])
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])  # map -> floor
    start = turn @ (low - map_T_floor[:2, 3]) - origin
    into_floor = np.column_stack([turn, start / resolution + (turn.sum(1) - 1) / 2])
    flat = cv2.warpAffine(
        image[::-1], into_floor, (int(columns), int(rows)), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        borderValue=[border] * 4,
    )  # fmt: skip
    return flat.astype(np.uint8), np.array([*low, outline[:, 2].mean()])


class FloorGrids:
    """Follows the service's status; calls back in a thread with the plan of each saved map."""

    def __init__(self, take: Callable[[U8, float, tuple[float, float], F64], None]) -> None:
        """Args: take, called with the arguments of `aligned`, map_T_floor in the axes of the map."""
        self._take = take
        self._made_of = ("", 0)  # folder and time of the save
        self._thread: threading.Thread | None = None

    def follow(self, status: Status) -> None:
        """Make the plan if the map has been saved since, and none is being made."""
        busy = self._thread is not None and self._thread.is_alive()
        saved = status.map_folder, status.map_saved_ns
        if busy or not all(saved) or saved == self._made_of:
            return
        self._made_of = saved
        self._thread = threading.Thread(target=self._make, args=(status.map_folder,), daemon=True)
        self._thread.start()

    def _make(self, folder: str) -> None:
        with tempfile.TemporaryDirectory(prefix="floor") as place:
            out = Path(place) / "plan.png"
            try:
                run_command(["export", folder, "--format", "floor-plan", "-o", str(out)], LONGEST_S)
            except StereoSfmError as error:
                log.warning("no floor plan: %s", error)
                return
            image = cv2.imread(str(out), cv2.IMREAD_GRAYSCALE)
            about = yaml.safe_load(out.with_suffix(".yaml").read_text())
        assert image is not None
        origin = float(about["origin"][0]), float(about["origin"][1])
        self._take(image.astype(np.uint8), float(about["resolution"]), origin, np.array(about["map_T_floor"], float))
