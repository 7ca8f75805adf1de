"""The floor plan of the saved map, made in a process of its own whenever the map has been saved."""

from __future__ import annotations

import logging
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.floor_plan import FREE, OCCUPIED, UNKNOWN, turned
from stereo_sfm.service.messages import Status
from stereo_sfm.service.outputs.background import run_command
from stereo_sfm.types import F64, U8

log = logging.getLogger("stereo_sfm")

LONGEST_S = 120.0
AGAIN_S = 60.0  # after an attempt that failed, as the machine was busy; then twice as long each time
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


class FloorGrids:
    """Follows the service's status; calls back in a thread with the plan of each saved map."""

    def __init__(self, take: Callable[[U8, float, tuple[float, float], F64], None]) -> None:
        """Args: take, called with the arguments of `aligned`, map_T_floor in the axes of the map."""
        self._take = take
        self._made_of = ("", 0)  # folder and time of the save
        self._begun_s, self._problem = 0.0, ""  # the newest attempt, and why it failed
        self._again_s = AGAIN_S
        self._thread: threading.Thread | None = None

    def follow(self, status: Status) -> None:
        """Make the plan if the map has been saved since, and none is being made."""
        busy = self._thread is not None and self._thread.is_alive()
        saved = status.map_folder, status.map_saved_ns
        again = self._problem and time.monotonic() > self._begun_s + self._again_s
        if busy or not all(saved) or (saved == self._made_of and not again):
            return
        self._again_s = 2 * self._again_s if again else AGAIN_S
        self._made_of, self._begun_s = saved, time.monotonic()
        self._thread = threading.Thread(target=self._make, args=(status.map_folder,), daemon=True)
        self._thread.start()

    def _make(self, folder: str) -> None:
        with tempfile.TemporaryDirectory(prefix="floor") as place:
            out = Path(place) / "plan.png"
            try:
                run_command(["export", folder, "--format", "floor-plan", "-o", str(out)], LONGEST_S)
            except StereoSfmError as error:
                if str(error) != self._problem:
                    log.warning("no floor plan: %s", error)
                self._problem = str(error)
                return
            image = cv2.imread(str(out), cv2.IMREAD_GRAYSCALE)
            about = yaml.safe_load(out.with_suffix(".yaml").read_text())
        assert image is not None
        self._problem = ""
        origin = float(about["origin"][0]), float(about["origin"][1])
        self._take(image.astype(np.uint8), float(about["resolution"]), origin, np.array(about["map_T_floor"], float))
