"""A floor plan of the store: occupancy from map points, free space from their rays, aligned with the aisles.

Written in the format of ROS's map_server: a grey image (white free, black occupied, grey unknown) and a YAML file.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.maps.floor import HIGH, LOW, find_floor, floor_of
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.types import F64, I32, U8

FREE, OCCUPIED, UNKNOWN = 254, 0, 205
MAX_RANGE = 6.0  # metres; farther stereo points are too uncertain
MARGIN = 0.5  # metres around the observed area
MIN_HITS = 3  # points in an occupied cell
MAX_CELLS = 10**8  # 500 m x 500 m at 5 cm


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """A floor plan. Row 0 of `image` has the largest y; cell (0, 0) of map_server is in the last row."""

    image: U8  # (H, W) FREE, OCCUPIED or UNKNOWN
    resolution: float  # metres per pixel
    origin: tuple[float, float]  # metres, lower left corner of the image in the floor frame
    map_T_floor: F64  # (4, 4) floor frame: x and y along the aisles and across, z up, z = 0 on the floor (or a robot's)


def make_floor_plan(s: MapSnapshot, resolution: float = 0.05, map_T_floor: F64 | None = None) -> FloorPlan:
    """Find the floor and the aisles' direction, where not given, then count hits and passing rays per cell.

    Raises:
        StereoSfmError: too few points, or an invalid resolution.
    """
    if not (math.isfinite(resolution) and resolution > 0):
        raise StereoSfmError(f"the resolution of a floor plan must be above 0 metres, not {resolution}")
    if len(s.points) < 50:
        raise StereoSfmError("the map holds too few points for a floor plan: map a longer path")
    map_T_floor = find_floor(s) if map_T_floor is None else map_T_floor
    points = se3.transform(se3.inverse(map_T_floor), s.points)
    cameras = se3.transform(se3.inverse(map_T_floor), s.map_T_kf[:, :3, 3])
    near = np.linalg.norm(points[s.obs_pt] - cameras[s.obs_kf], axis=1) < MAX_RANGE
    rays_kf, rays_pt = s.obs_kf[near], s.obs_pt[near]
    used = points[np.unique(rays_pt)]
    solid = used[(used[:, 2] > LOW) & (used[:, 2] < HIGH)]
    corners = np.concatenate([solid[:, :2], cameras[:, :2]])
    low = np.floor((corners.min(0) - MARGIN) / resolution) * resolution
    cells = np.ceil((corners.max(0) + MARGIN - low) / resolution)
    if not cells.prod() <= MAX_CELLS:
        raise StereoSfmError(
            f"a floor plan with {resolution:g} m per pixel would have {cells[0]:.3g} x {cells[1]:.3g} pixels: "
            "choose more metres a pixel"
        )
    size = cells.astype(int)
    passed = np.zeros((size[1], size[0]), np.int32)
    _trace(np.ascontiguousarray(cameras[rays_kf]), np.ascontiguousarray(points[rays_pt]), low, resolution, passed)
    hits = np.zeros_like(passed)
    cell = ((solid[:, :2] - low) / resolution).astype(int)
    np.add.at(hits, (cell[:, 1], cell[:, 0]), 1)
    return FloorPlan(_paint(hits, passed), resolution, (float(low[0]), float(low[1])), map_T_floor)


def _paint(hits: I32, passed: I32) -> U8:
    import cv2

    blurred = cv2.boxFilter(hits.astype(np.float32), -1, (3, 3), normalize=False)
    rays = cv2.boxFilter(passed.astype(np.float32), -1, (3, 3))
    occupied = (hits > 0) & (blurred >= MIN_HITS) & (blurred > 0.25 * rays)
    image = np.full(hits.shape, UNKNOWN, np.uint8)
    image[passed > 1] = FREE  # a single ray may belong to an outlier
    image[occupied] = OCCUPIED
    return np.ascontiguousarray(image[::-1])


@njit
def _trace(start, end, low, resolution, passed):
    """Count each ray in the cells it crosses between floor and shelf height, up to one cell before its point."""
    h, w = passed.shape
    for k in range(start.shape[0]):
        dx, dy, dz = end[k, 0] - start[k, 0], end[k, 1] - start[k, 1], end[k, 2] - start[k, 2]
        length = math.sqrt(dx * dx + dy * dy)
        steps = int(length / (0.5 * resolution)) - 4
        last_x, last_y = -1, -1
        for i in range(steps):
            f = i * 0.5 * resolution / length
            z = start[k, 2] + f * dz
            if z < 0.02 or z > 1.9:
                continue
            x = int((start[k, 0] + f * dx - low[0]) / resolution)
            y = int((start[k, 1] + f * dy - low[1]) / resolution)
            if (x != last_x or y != last_y) and 0 <= x < w and 0 <= y < h:
                passed[y, x] += 1
                last_x, last_y = x, y


def turned(image: U8, resolution: float, origin: tuple[float, float], map_T_floor: F64, border: int) -> tuple[U8, F64]:
    """A picture from above in the axes of the map, the first row with the least y; its corner with the least x and y.

    Args:
        image: (H, W) or (H, W, C); the last row has the least y.
        resolution: metres per pixel.
        origin: metres, corner with the least x and y in the floor's frame.
        map_T_floor: (4, 4) the floor in the robot's map.
        border: around it.
    """
    import cv2

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


def in_robots_map(plan: FloorPlan, base_T_left: F64, border: int = UNKNOWN) -> FloorPlan:
    """A plan in the axes of the poses that robots get, as `map_server` takes it: Nav2 takes no grid that is turned.

    Args:
        base_T_left: (4, 4) of the rig. border: around the plan.
    """
    image, corner = turned(plan.image, plan.resolution, plan.origin, base_T_left @ plan.map_T_floor, border)
    place = (float(corner[0]), float(corner[1])), se3.inverse(base_T_left)
    return FloorPlan(np.ascontiguousarray(image[::-1]), plan.resolution, *place)


def plan_files(path: Path) -> tuple[Path, Path]:
    """PATH.png and PATH.yaml, or PATH.pgm; `path` may have a suffix, any other dot is part of the name."""
    ending = ".pgm" if path.suffix == ".pgm" else ".png"
    name = path.name.removesuffix(ending).removesuffix(".yaml")
    return path.with_name(f"{name}{ending}"), path.with_name(f"{name}.yaml")


def description(plan: FloorPlan, image: str) -> str:
    """The YAML of map_server for an image of a plan's size."""
    import yaml

    fields = {
        "image": image,
        "resolution": plan.resolution,
        "origin": [plan.origin[0], plan.origin[1], 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
        "mode": "trinary",
        "map_T_floor": plan.map_T_floor.tolist(),
    }
    return yaml.safe_dump(fields, sort_keys=False)


def write_floor_plan(plan: FloorPlan, path: Path) -> None:
    """Write the two `plan_files` of a path."""
    from stereo_sfm.pixels import write_image

    image, about = plan_files(path)
    write_image(image, plan.image)
    about.write_text(description(plan, image.name), encoding="utf-8")


def export_floor_plan(saved: SavedMap, path: Path, resolution: float = 0.05) -> FloorPlan:
    """Make the floor plan of a map and write it."""
    plan = make_floor_plan(saved.snapshot, resolution, floor_of(saved))
    write_floor_plan(plan, path)
    return plan
