"""After a correction of the rig, corners are where the corrected rig sees them."""

from __future__ import annotations

import numpy as np

from stereo_sfm.mapping.map import Map
from stereo_sfm.mapping.recalibration import recalibrate
from stereo_sfm.types import Corners, Keyframe
from tests.synthetic import fisheye_rig, turned

RIGHT = fisheye_rig()
WRONG = turned(RIGHT, (0.1, 0.3, -0.1))
POINTS = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 4], (50, 3))


def keyframe(k: int) -> Keyframe:
    """With corners that the right rig saw, at the distances that the wrong one measured."""
    uv_left, uv_right = RIGHT.left.project(POINTS), RIGHT.project_right(POINTS)
    left, right, points = (a.astype(np.float32) for a in (uv_left, uv_right, 1.1 * POINTS))
    corners = Corners(left, right, points, np.zeros((50, 32), np.uint8))
    none, uv = np.zeros(0, np.int64), np.zeros((0, 2))
    return Keyframe(
        k, k, k, np.eye(4), none, uv, uv.copy(), np.zeros((0, 3)), np.zeros((0, 32), np.uint8), corners=corners
    )


def test_corners_move_to_where_the_corrected_rig_sees_them() -> None:
    map_ = Map()
    map_.add_keyframe(keyframe(0), np.eye(4))
    recalibrate(map_, [(0, WRONG), (0, RIGHT)])
    corners, sides = map_.corners[0]
    np.testing.assert_allclose(corners.points_cam, POINTS, rtol=2e-3, atol=2e-3)
    assert len(sides) == 0


def test_corners_from_before_a_step_stay_where_they_were() -> None:
    map_ = Map()
    for k in range(2):
        map_.add_keyframe(keyframe(k), np.eye(4))
    recalibrate(map_, [(0, RIGHT), (1, WRONG)])  # the rig was right until keyframe 1
    before, after = (map_.corners[row][0].points_cam for row in (0, 1))
    off = np.linalg.norm(before - POINTS, axis=1) / np.linalg.norm(POINTS, axis=1)
    assert np.median(off) < 0.02
    assert np.abs(after - POINTS).max() > 0.1
    uv_right = map_.corners[0][0].uv_right
    assert np.median(np.linalg.norm(uv_right - WRONG.project_right(POINTS), axis=1)) < 0.5
