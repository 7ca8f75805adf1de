"""Decentering of the right lens: the displacement of pixels that it stands for."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.calib.scene_model import decentered
from stereo_sfm.geometry import se3
from tests.synthetic import fisheye_rig, pinhole_rig


@pytest.mark.parametrize(("along_x", "along_y"), [(0.009, 0.0), (0.0, 0.009)])
def test_pixels_move_as_documented(along_x: float, along_y: float) -> None:
    rig = pinhole_rig()
    assert rig.right is not None
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.3, 0.3, 5))
    points = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    after = decentered(rig, along_x, along_y)
    assert after.right is not None
    seen = after.right.project(se3.transform(se3.inverse(after.left_T_right) @ rig.left_T_right, points))
    moved = (seen - rig.right.project(points)).reshape(*x.shape, 2)
    u, v = -along_x * y * y - along_y * x * y, along_x * x * y + along_y * x * x
    np.testing.assert_allclose(moved, rig.right.fx * np.stack([u, v], -1), atol=0.04)
    assert after.baseline == pytest.approx(rig.baseline)


def test_nothing_changes_without_decentering_or_with_a_fisheye() -> None:
    rig, fisheye = pinhole_rig(), fisheye_rig()
    assert decentered(rig, 0.0, 0.0) is rig
    assert decentered(fisheye, 0.01, 0.01) is fisheye
