"""Live depth: where obstacles are, that the floor is none, which images get a depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import DenseConfig
from stereo_sfm.dense.live import Chosen, LiveDepthMaker, Paced
from stereo_sfm.dense.obstacles import obstacles, upwards
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, ImuSamples, StereoImage
from tests.dense.test_depth import render
from tests.synthetic import fisheye_rig, pinhole_rig

HEIGHT_M = 0.6
LEVEL = np.array([0.0, -1.0, 0.0])  # against gravity, in an upright camera
WALLS = [(1, HEIGHT_M), (2, 2.5), (0, -1.2)]  # floor, ahead, left


def pair(rig: Rig, frame_id: int = 0, pose: F64 | None = None, walls: list[tuple[int, float]] = WALLS) -> StereoImage:
    pose = np.eye(4) if pose is None else pose
    left, right = (render(c, p, walls)[0] for c, p in ((rig.left, pose), (rig.right, pose @ rig.left_T_right)))
    return StereoImage(frame_id, 10**9 + frame_id * 50_000_000, left, right)


@pytest.mark.parametrize("rig", [pinhole_rig(), fisheye_rig()], ids=["pinhole", "fisheye"])
def test_walls_are_obstacles_and_the_floor_is_not(rig: Rig) -> None:
    live = LiveDepthMaker(rig, DenseConfig(range_m=4.0, camera_height_m=HEIGHT_M)).step(pair(rig))
    assert live is not None
    fx, fy, cx, cy = live.pinhole.tolist()
    v, u = np.nonzero(live.depth_mm)
    depth = live.depth_mm[v, u] / 1000.0
    points = np.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], axis=1)
    seen = live.points(3)
    uv = seen[:, :2] / seen[:, 2:] * live.pinhole[:2] + live.pinhole[2:]
    np.testing.assert_allclose(uv, np.rint(uv), atol=1e-6)
    column, row = np.rint(uv).astype(int).T
    np.testing.assert_array_equal(np.rint(1000 * seen[:, 2]), live.depth_mm[row, column])
    assert len(seen) == (live.depth_mm[::3, ::3] > 0).sum()
    off = np.min([np.abs(points[:, axis] - place) for axis, place in WALLS], axis=0)
    assert len(points) > 0.6 * live.depth_mm.size
    assert np.median(off / depth) < 0.04, "on the surfaces, by its own camera"
    off = np.min([np.abs(live.obstacles[:, axis] - place) for axis, place in WALLS[1:]], axis=0)
    assert len(live.obstacles) > 100
    assert np.quantile(off / np.linalg.norm(live.obstacles, axis=1), 0.9) < 0.1
    above = HEIGHT_M - live.obstacles[:, 1]
    middle = (np.abs(live.obstacles[:, 2] - 1.5) < 0.5) & (np.abs(live.obstacles[:, 0]) < 0.8)
    assert (above > 0.1).all()
    assert middle.sum() <= 3, "nothing stands on the floor between"


def scene(up: F64, height: float, rng: np.random.Generator) -> tuple[F64, F64, F64]:
    """Noisy ranges (1, N), standard deviations and rays to a floor and a box of 20 cm on it, in a tilted camera."""
    x, z = rng.uniform(-1.5, 1.5, 40_000), rng.uniform(0.8, 4.0, 40_000)
    box = (np.abs(x) < 0.3) & (np.abs(z - 2.0) < 0.3)
    points = np.stack([x, height - 0.2 * box, z], axis=1)
    turn = se3.exp(np.array([0, 0, 0, *np.cross(LEVEL, up)]))[:3, :3]  # small: the cross product is the rotation
    points = points @ turn.T
    true = np.linalg.norm(points, axis=1)
    sigma = 0.01 * true**2
    return (true + sigma * rng.normal(size=len(true)))[None], sigma[None], (points / true[:, None])[None]


@pytest.mark.parametrize("tilt_deg", [-3.0, 0.0, 3.0])
@pytest.mark.parametrize("known", [True, False])
def test_a_low_box_on_the_floor_is_found_by_a_robot_that_nods(tilt_deg: float, known: bool) -> None:
    """Gravity's direction is 3 degrees off: at 4 m that is twice the least height of an obstacle."""
    rng = np.random.default_rng(3)
    tilt = np.deg2rad(tilt_deg)
    up = np.array([0.0, -np.cos(tilt), np.sin(tilt)])
    ranges, sigmas, rays = (a.astype(np.float32) for a in scene(up, HEIGHT_M, rng))
    found = obstacles(ranges, sigmas, rays, LEVEL, HEIGHT_M if known else 0.0, DenseConfig(min_height_m=0.1))
    on_box = (np.abs(found[:, 0]) < 0.4) & (np.abs(found[:, 2] - 2.0) < 0.45)
    assert on_box.sum() > 50
    assert (~on_box).sum() < 0.02 * on_box.sum()


def test_height_and_range_have_limits() -> None:
    rng = np.random.default_rng(3)
    ranges, sigmas, rays = (a.astype(np.float32) for a in scene(LEVEL, HEIGHT_M, rng))
    for limits in ({"max_height_m": 0.15}, {"range_m": 1.5}, {"min_height_m": 0.5}):
        assert not len(obstacles(ranges, sigmas, rays, LEVEL, HEIGHT_M, DenseConfig(**limits)))
    assert obstacles(ranges * np.nan, sigmas, rays, LEVEL, HEIGHT_M, DenseConfig()).shape == (0, 3)


def test_gravity_is_felt_at_rest_and_the_body_tells_it_otherwise() -> None:
    turned = se3.exp(np.array([0, 0, 0, 0.1, 0.0, 0.0]))
    rig = replace(pinhole_rig(), imu=Imu(turned))
    samples = ImuSamples(np.arange(4), np.zeros((4, 3)), np.tile([0.0, -9.80665, 0.0], (4, 1)))
    np.testing.assert_allclose(upwards(rig, samples), turned[:3, :3] @ LEVEL)
    braking = ImuSamples(np.arange(4), np.zeros((4, 3)), np.tile([0.0, -9.8, 6.0], (4, 1)))
    np.testing.assert_allclose(upwards(rig, braking), LEVEL, atol=1e-12)
    np.testing.assert_allclose(upwards(rig, None), LEVEL, atol=1e-12)


def test_an_image_alone_decides_its_depth_and_one_camera_has_none() -> None:
    rig = pinhole_rig()
    maker = LiveDepthMaker(rig, DenseConfig())
    first, second = pair(rig, 1), pair(rig, 2, se3.exp(np.array([0.0, 0, 0.3, 0, 0, 0])))
    once = maker.step(second)
    maker.step(first)
    again = maker.step(second)
    assert once is not None and again is not None
    np.testing.assert_array_equal(once.depth_mm, again.depth_mm)
    np.testing.assert_array_equal(once.obstacles, again.obstacles)
    assert maker.step(replace(first, right=None)) is None
    with pytest.raises(StereoSfmError, match="needs two cameras"):
        LiveDepthMaker(Rig(rig.left), DenseConfig())


def stamped(times_s: list[float]) -> list[StereoImage]:
    grey = np.zeros((2, 2), np.uint8)
    return [StereoImage(k, round(t * 1e9), grey, grey) for k, t in enumerate(times_s)]


def test_the_rate_is_kept_whatever_the_cameras() -> None:
    images = stamped([k / 30 for k in range(300)])
    paced = Paced(7.0)
    chosen = []
    for image in images:
        if paced.due(image):
            paced.taken(image)
            chosen.append(image.frame_id)
    assert len(chosen) == 70
    again = Chosen(frozenset(chosen))
    assert [i.frame_id for i in images if again.due(i)] == chosen


def test_what_could_not_be_made_in_time_is_not_made_up_for() -> None:
    images = stamped([0.0, 0.1, 0.9, 0.95, 1.0, 1.05])
    paced = Paced(10.0)
    chosen = []
    for image in images:
        if paced.due(image) and image.frame_id != 1:  # busy then
            paced.taken(image)
            chosen.append(image.frame_id)
    assert chosen == [0, 2, 4]
