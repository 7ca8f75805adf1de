"""The floor plan in the axes of the map: no grid is turned, and no wall moves."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.export.floor_plan import FREE, OCCUPIED, UNKNOWN
from stereo_sfm.geometry import se3
from stereo_sfm.service.outputs.floor_grid import FloorGrid, aligned


def _cell(grid: FloorGrid, x: float, y: float) -> int:
    column, row = np.floor((np.array([x, y]) - grid.origin[:2]) / grid.resolution).astype(int)
    return int(grid.cells[row, column])


@pytest.mark.parametrize("yaw", [0.0, 0.3, -1.2, np.pi / 2, 3.0])
def test_walls_stay_where_they_are(yaw: float) -> None:
    resolution, origin = 0.1, (-2.0, -1.0)
    image = np.full((40, 60), FREE, np.uint8)  # 6 m x 4 m, the last row at y = -1
    image[:10] = UNKNOWN  # y above 2
    image[20:26, 30:36] = OCCUPIED  # x 1 ... 1.6, y 0.4 ... 1
    map_T_floor = se3.exp(np.array([0.7, -0.4, -0.3, 0, 0, yaw]))
    grid = aligned(image, resolution, origin, map_T_floor)
    for x, y, value in ((1.3, 0.7, 100), (1.05, 0.45, 100), (1.8, 0.7, 0), (0, 0, 0), (0, 2.6, -1), (-1.9, -0.9, 0)):
        at = se3.transform(map_T_floor, np.array([[x, y, 0.0]]))[0]
        assert _cell(grid, at[0], at[1]) == value, (x, y)
    assert (grid.cells == 100).sum() == pytest.approx(36, abs=4)
    assert grid.origin[2] == pytest.approx(map_T_floor[2, 3])
    if yaw == 0:
        np.testing.assert_array_equal((grid.cells == 100).sum(), 36)
