"""What the page shows: the newest of everything, as plain values. Nothing here grows with time."""

from __future__ import annotations

import itertools
import json
import threading
import time
from collections import deque
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np

from stereo_sfm.log.run_log import age_colors
from stereo_sfm.service.messages import (
    Event,
    HealthReport,
    MapCloud,
    PoseUpdate,
    PreviewImage,
    ServiceMessage,
    Started,
    Status,
)
from stereo_sfm.service.outputs.floor_grid import FloorGrid, FloorGrids, RawPlan, aligned
from stereo_sfm.service.outputs.robot_axes import RobotAxes
from stereo_sfm.types import F64, U8

EVENTS = 60  # lines that are kept
WIDEST = 640  # pixels of the image
JPEG_QUALITY = 75
WATCHED_S = 3.0  # images are drawn while one was requested within so many seconds
MOST_POINTS, MOST_KEYFRAMES = 6000, 3000  # of the map as it is shown
FARTHEST_M = 1e5  # of a point that is shown
CELL_M = 0.05  # points of one cell are shown as one


class PageState:
    """Collects messages in one thread; read by others."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._axes: RobotAxes | None = None
        self._values: dict[str, Any] = {"source": "", "status": None, "pose": None, "health": None, "map_version": 0}
        self._values["plan"] = None
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS)
        self._map: dict[str, Any] = {"version": 0, "points": [], "path": []}
        self._jpeg = b""
        self._plan_png = b""
        self._plans = FloorGrids(self._take_plan)
        self._plan: RawPlan | None = None  # the newest
        self._versions = itertools.count(time.time_ns() // 1_000_000)  # an open page outlives a service
        self._watched = self._viewed = -WATCHED_S

    def put(self, message: ServiceMessage) -> None:
        """Show a message."""
        if isinstance(message, PreviewImage):
            self._take_image(message)
        elif isinstance(message, MapCloud):
            self._take_map(message)
        else:
            with self._lock:
                self._store(message)

    def _store(self, message: ServiceMessage) -> None:
        if isinstance(message, Started):
            self._axes = RobotAxes(message.rig)
            self._values["source"] = message.source
            self._draw_plan()
        elif isinstance(message, Status):
            self._values["status"] = asdict(message)
            if time.monotonic() - self._viewed < WATCHED_S:
                self._plans.follow(message)
        elif isinstance(message, PoseUpdate) and self._axes is not None:
            self._values["pose"] = _pose(message, self._axes)
        elif isinstance(message, HealthReport):
            self._values["health"] = asdict(message)
        elif isinstance(message, Event):
            self._events.append(asdict(message))

    def _take_map(self, cloud: MapCloud) -> None:
        axes = self._axes
        if axes is None:
            return
        shown = cloud.points[(np.abs(cloud.points) < FARTHEST_M).all(axis=1)]  # others have no place in JSON
        points = _thinned(axes.points(shown.astype(float)))
        path = axes.cameras(cloud.map_T_kf)[:, :3, 3]
        path = path[:: 1 + len(path) // MOST_KEYFRAMES]
        with self._lock:
            version = self._values["map_version"] = next(self._versions)
            self._map = {"version": version, "points": _rounded(points), "path": _rounded(path[:, :2])}

    def _take_image(self, preview: PreviewImage) -> None:
        if time.monotonic() - self._watched < WATCHED_S:
            self._jpeg = _drawn(preview)

    def _take_plan(self, image: U8, resolution: float, origin: tuple[float, float], map_T_floor: F64) -> None:
        """A new floor plan of the saved map, in a thread of its own."""
        with self._lock:
            self._plan = image, resolution, origin, map_T_floor
            self._draw_plan()

    def _draw_plan(self) -> None:
        """The floor plan in the axes of the poses, once both are known."""
        if self._axes is None or self._plan is None:
            return
        image, resolution, origin, map_T_floor = self._plan
        grid = aligned(image, resolution, origin, self._axes.in_map(map_T_floor))
        self._plan_png, self._values["plan"] = _plan_png(grid), {"version": next(self._versions), **_plan_extent(grid)}

    @property
    def axes(self) -> RobotAxes | None:
        """Of the camera; None before the start."""
        return self._axes

    def floor_plan(self) -> bytes:
        """The floor plan as PNG, x up and y to the left, where `plan` of the snapshot says; empty at first."""
        return self._plan_png

    def snapshot(self) -> str:
        """State, pose, health, extent of the floor plan and events as JSON; NaN becomes null."""
        self._viewed = time.monotonic()
        with self._lock:
            text = json.dumps({**self._values, "events": list(self._events)}, default=str)
        return json.dumps(json.loads(text, parse_constant=lambda _: None), separators=(",", ":"))

    def map(self) -> str:
        """The map seen from above, as JSON: metres in the robot's axes; points are x y z."""
        with self._lock:
            return json.dumps(self._map, separators=(",", ":"))

    def jpeg(self) -> bytes:
        """The newest image with its tracks, empty at first."""
        self._watched = time.monotonic()
        return self._jpeg


def _pose(update: PoseUpdate, axes: RobotAxes) -> dict[str, Any]:
    pose = axes.pose(update)
    x, y, z = pose.map_T_base[:3, 3].tolist()
    heading = float(np.arctan2(pose.map_T_base[1, 0], pose.map_T_base[0, 0]))
    sigma = float(np.sqrt(max(np.trace(pose.covariance[:3, :3]), 0.0)))
    speed = float(np.linalg.norm(pose.twist[:3]))
    return {
        "x": x, "y": y, "z": z, "heading": heading, "sigma_m": sigma, "speed": speed, "state": update.state,
        "reason": update.reason, "tracked": update.tracked, "localized": update.localized, "frame_id": update.frame_id,
    }  # fmt: skip


def _thinned(points: F64) -> F64:
    """(N, 3) one point a cell, and not more than can be drawn."""
    _, first = np.unique(np.round(points / CELL_M).astype(np.int64), axis=0, return_index=True)
    kept = points[np.sort(first)]
    return kept[:: 1 + len(kept) // MOST_POINTS]


def _plan_png(grid: FloorGrid) -> bytes:
    """Free cells white, occupied ones dark, unknown ones transparent; the first row has the largest x."""
    cells = grid.cells.T[::-1, ::-1]
    image = np.zeros((*cells.shape, 4), np.uint8)  # blue, green, red, opacity
    image[cells == 0] = (255, 255, 255, 255)
    image[cells == 100] = (60, 50, 40, 255)
    return cv2.imencode(".png", image)[1].tobytes()


def _plan_extent(grid: FloorGrid) -> dict[str, float]:
    """Metres in the robot's map: largest x and y, size along x and along y."""
    rows, columns = grid.cells.shape
    along_x, along_y = columns * grid.resolution, rows * grid.resolution
    return {"x": grid.origin[0] + along_x, "y": grid.origin[1] + along_y, "along_x": along_x, "along_y": along_y}


def _rounded(values: F64) -> list[list[float]]:
    return np.round(values, 2).tolist()


def _drawn(preview: PreviewImage) -> bytes:
    """The left image with a dot for each track: blue when new, red when old, grey where the pose does not use it."""
    scale = min(1.0, WIDEST / preview.left.shape[1])
    small: U8 = cv2.resize(preview.left, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.uint8)
    image = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    colors = (age_colors(preview.age, preview.inlier)[:, 2::-1] * 255).astype(int)
    for (u, v), color in zip(np.round(preview.uv * scale).astype(int).tolist(), colors.tolist(), strict=True):
        cv2.circle(image, (u, v), 2, color, -1, cv2.LINE_AA)
    return cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1].tobytes()
