"""Views that face the shelves: corners found in them are seen from the other direction too."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.drivers.sim.rigs import make_rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.loop import binary
from stereo_sfm.tracking.flow.klt import build_pyramid
from stereo_sfm.tracking.flow.place_corners import PlaceCorners
from stereo_sfm.tracking.flow.side_views import SideViews
from stereo_sfm.types import F64, U8, Corners

WALL = 1.2  # metres from the middle of the aisle to the fronts


def texture(seed: int) -> U8:
    """Fronts with 100 px a metre, 20 m long."""
    noise = np.random.default_rng(seed).uniform(0, 255, (60, 400)).astype(np.float32)
    return np.asarray(cv2.resize(noise, (2000, 300), interpolation=cv2.INTER_CUBIC).clip(0, 255), np.uint8)


def picture(camera: Camera, world_T_cam: F64, fronts: tuple[U8, U8]) -> U8:
    """The image (H, W) of two fronts at x = -WALL and x = WALL, along z."""
    rays = camera.bearing_grid() @ world_T_cam[:3, :3].T
    image = np.zeros(rays.shape[:2], np.uint8)
    for side, front in zip((-1.0, 1.0), fronts, strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (side * WALL - world_T_cam[0, 3]) / rays[..., 0]
            place = world_T_cam[:3, 3] + reach[..., None] * rays
            map_x, map_y = 100 * (place[..., 2] + 6), 100 * (place[..., 1] + 1.5)
        seen = cv2.remap(
            front, *(np.nan_to_num(m, nan=-1e3).astype(np.float32) for m in (map_x, map_y)), cv2.INTER_LINEAR
        )
        image = np.where((reach > 0) & (reach < 8), seen, image)
    return np.ascontiguousarray(image)


def look(rig: Rig, world_T_cam: F64, seed: int = 0) -> Corners:
    """What the side views of one stereo image find."""
    fronts = texture(2 * seed), texture(2 * seed + 1)
    assert rig.right is not None
    left = build_pyramid(picture(rig.left, world_T_cam, fronts), 4)
    right = build_pyramid(picture(rig.right, world_T_cam @ rig.left_T_right, fronts), 2)
    config = Config()
    corners, views = PlaceCorners.from_config(config, rig), SideViews.from_config(config, rig)
    assert corners is not None and views is not None
    return views.find(left, right, corners.find_in(left, right), np.eye(4), 0)


def pose(x: float, z: float, yaw_deg: float) -> F64:
    return se3.from_rotation_translation(se3.so3_exp(np.array([0, np.deg2rad(yaw_deg), 0])), np.array([x, 0.0, z]))


def matched(a: Corners, b: Corners, pose_a: F64, pose_b: F64) -> tuple[int, float]:
    """How many corners look alike, and the share of them that are one point of the fronts."""
    rows_b, rows_a = binary.match_descriptors(b.descriptors, a.descriptors, None, 60, 0.9)
    at_a = se3.transform(pose_a, a.points_cam[rows_a].astype(float))
    at_b = se3.transform(pose_b, b.points_cam[rows_b].astype(float))
    return len(rows_b), float((np.linalg.norm(at_a - at_b, axis=1) < 0.3).sum()) / max(len(rows_b), 1)


@pytest.mark.parametrize("turn_deg", [0.0, 12.0])
def test_corners_are_seen_from_the_other_direction(turn_deg: float) -> None:
    rig = make_rig("fisheye", (424, 400))
    there, back = pose(0.1, 0.0, turn_deg), pose(-0.1, 1.6, 180.0 - turn_deg / 2)
    a, b = look(rig, there), look(rig, back)
    assert len(a) > 200 and len(b) > 200
    count, right = matched(a, b, there, back)
    assert count > 40 and right > 0.6
    other, _ = matched(a, look(rig, back, seed=1), there, back)
    assert other < 0.5 * count  # fronts that look different


def test_points_lie_where_the_pixels_say() -> None:
    rig = make_rig("fisheye", (424, 400))
    corners = look(rig, pose(0.0, 0.0, 5.0))
    uv = rig.left.project(corners.points_cam.astype(float))
    assert np.abs(uv - corners.uv_left).max() < 0.05
    beside = se3.transform(pose(0.0, 0.0, 5.0), corners.points_cam.astype(float))
    assert np.median(np.abs(np.abs(beside[:, 0]) - WALL)) < 0.08


def test_views_near_the_last_ones_say_nothing_new() -> None:
    rig, config = make_rig("fisheye", (424, 400)), Config()
    image = picture(rig.left, pose(0, 0, 0), (texture(0), texture(1)))
    left, right = build_pyramid(image, 4), build_pyramid(image, 2)
    views = SideViews.from_config(config, rig)
    assert views is not None
    views.find(left, right, Corners.none(), np.eye(4), 0)
    assert not views._due(pose(0, 0.1, 3.0), 0)
    assert views._due(pose(0, 0.5, 0.0), 0) and views._due(pose(0, 0.0, 40.0), 0) and views._due(np.eye(4), 1)
