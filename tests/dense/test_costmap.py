"""A slice of the volume as `map_server` of Nav2 reads it: nav2_map_server's loadMapYaml and loadMapFromFile."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import yaml

from stereo_sfm.dense.build import ROBOT
from stereo_sfm.dense.files import costmaps
from stereo_sfm.dense.volume import SIDE
from stereo_sfm.export.floor_plan import write_floor_plan
from stereo_sfm.types import Bool

VOXEL = 0.05
OCCUPIED, FREE, UNKNOWN = 100, 0, -1  # of nav_msgs/OccupancyGrid


def cube(index: tuple[int, int, int], occupied: Bool, free: Bool) -> tuple[tuple[int, int, int], Bool, Bool]:
    return index, occupied[None], free[None]


class MapServer:
    """The grid that it would publish; cell (0, 0) at the origin, rows along y."""

    def __init__(self, path: Path) -> None:
        about = yaml.safe_load(path.read_text())
        assert {"image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"} <= set(about)
        assert 0 <= about["free_thresh"] < about["occupied_thresh"] <= 1 and about["mode"] == "trinary"
        self.resolution, self.origin = float(about["resolution"]), [float(x) for x in about["origin"]]
        assert len(self.origin) == 3 and self.origin[2] == 0, "x, y and yaw"
        image = cv2.imread(str(path.parent / about["image"]), cv2.IMREAD_UNCHANGED)
        assert image is not None and image.ndim == 2 and image.dtype == np.uint8
        shade = image[::-1] / 255.0  # the first row of a picture is its top
        occupancy = shade if about["negate"] else 1 - shade
        self.grid = np.full(image.shape, UNKNOWN)
        self.grid[occupancy >= about["occupied_thresh"]] = OCCUPIED
        self.grid[occupancy <= about["free_thresh"]] = FREE

    def at(self, x: float, y: float) -> int:
        column, row = ((value - start) / self.resolution for value, start in zip((x, y), self.origin, strict=False))
        return int(self.grid[int(np.floor(row)), int(np.floor(column))])


def test_map_server_reads_each_place_as_it_was_seen(tmp_path: Path) -> None:
    """A shelf along x at y = 1 m, a pillar in a cube at negative places, free floor between, nothing beyond."""
    shelf, floor, pillar, none = (np.zeros((SIDE, SIDE), bool) for _ in range(4))
    shelf[:, 20] = True  # columns along x, y
    floor[:, :20] = True
    pillar[SIDE - 4, SIDE - 2] = True
    results = [
        cube((0, 0, 0), shelf, none),
        cube((0, 0, 1), none, floor | shelf),  # seen through above the shelf: the shelf stays
        cube((-1, -1, 0), pillar, none),
    ]
    volume: Any = SimpleNamespace(
        indices=[r[0] for r in results], voxel=VOXEL, map_T_floor=np.eye(4), columns=lambda _: iter(results)
    )
    write_floor_plan(costmaps(volume, ROBOT)[0], tmp_path / "costmap_0.10_0.60")
    server = MapServer(tmp_path / "costmap_0.10_0.60.yaml")
    for x in (0.0, 1.0, 3.15):  # where the voxels are
        assert server.at(x, 1.0) == OCCUPIED
        assert server.at(x, 0.95) == FREE
        assert server.at(x, 1.05) == UNKNOWN
    assert server.at(-0.2, -0.1) == OCCUPIED
    assert (server.grid == OCCUPIED).sum() == SIDE + 1
    assert server.grid.shape == (2 * SIDE, 2 * SIDE) and server.resolution == VOXEL
