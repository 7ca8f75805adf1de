"""Geometry, filtering and sensor of the simulator against their exact models."""

from __future__ import annotations

import dataclasses
import functools

import cv2
import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.sim.drives import FORWARD
from stereo_sfm.drivers.sim.effects import CLEAN, Effects, Sensor
from stereo_sfm.drivers.sim.kernels import BLOCK, FACING, FRONT, PERSON, ROOM, TARGET
from stereo_sfm.drivers.sim.people import crowd_at, moving
from stereo_sfm.drivers.sim.render import Renderer, View
from stereo_sfm.drivers.sim.rigs import CAMERAS, make_rig
from stereo_sfm.drivers.sim.scenes import crowd
from stereo_sfm.drivers.sim.tables import Tables
from stereo_sfm.drivers.sim.targets import FlatTarget, empty_room, move, place
from stereo_sfm.drivers.sim.world import Layout, build_world
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, U8

SMALL = Layout(gondolas=2, gondola_length=5.0, products=40)


@functools.cache
def store(exchange: float = 0.0) -> Tables:
    return build_world(SMALL, seed=3, exchange=exchange)


@functools.cache
def renderer(camera: str) -> Renderer:
    size = (424, 400) if camera == "fisheye" else (320, 200)
    return Renderer(store(), make_rig(camera, size))


def pose_at(x: float, y: float, heading: float, pitch: float = -0.1) -> F64:
    pose = np.eye(4)
    pose[:3, :3] = se3.so3_exp(np.array([0, 0, heading])) @ FORWARD @ se3.so3_exp(np.array([pitch, 0.02, 0.03]))
    pose[:3, 3] = x, y, 1.3
    return pose


POSE = pose_at(4.0, SMALL.aisle_y(1) + 0.2, 0.3)


def hit_points(renderer: Renderer, side: int, view: View, pose: F64) -> F64:
    """(H, W, 3) in the world."""
    return se3.transform(pose, renderer.cameras[side].grid * view.depth[..., None])


def kind_of(view: View) -> np.ndarray:
    return np.where(view.ids >= 0, (view.ids >> 4) & 7, -1)


def test_rows_of_a_rolling_shutter_see_what_their_own_pose_sees() -> None:
    r = renderer("pinhole")
    height = r.rig.left.height
    poses = np.array(
        [POSE @ se3.exp(np.array([0.02, 0.01, 0.03, 0.0, 0.05, 0.02]) * s) for s in np.linspace(-1, 1, height)]
    )
    rolling = r.render(poses)
    for row in (0, 57, 100, height - 1):
        still = r.render(poses[row])
        for side in (0, 1):
            assert np.array_equal(rolling[side].depth[row], still[side].depth[row], equal_nan=True)
            assert np.array_equal(rolling[side].ids[row], still[side].ids[row])


@pytest.mark.parametrize("camera", sorted(CAMERAS))
def test_hits_lie_on_the_surfaces_they_name(camera: str) -> None:
    r, world = renderer(camera), store()
    view = r.view(0, POSE)
    points, kind = hit_points(r, 0, view, POSE), kind_of(view)
    assert {ROOM, BLOCK, FACING} <= set(np.unique(kind).tolist())
    floor = (kind == ROOM) & ((view.ids & 15) == 0)
    assert floor.sum() > 500
    assert np.abs(points[floor][:, 2]).max() < 2e-6 * 20
    front = (kind == FACING) & ((view.ids & 15) == FRONT)
    index = view.ids[front] >> 12
    block = world.facings_i[index, 3]
    facing = world.blocks_i[block, 1]
    assert set(np.unique(facing).tolist()) >= {0, 1}
    for side, plane in ((0, world.blocks[block, 1]), (1, world.blocks[block, 4])):
        sign = 1 if side == 0 else -1
        expected = plane + sign * world.facings[index, 4]
        mine = facing == side
        assert np.abs(points[front][mine][:, 1] - expected[mine]).max() < 1e-5


def product_boxes(world: Tables) -> F64:
    """(2 F, 6) lower and upper boxes of every facing in world axes, lo xyz, hi xyz; empty ones have hi below lo."""
    out = np.empty((2, len(world.facings), 6))
    for c, (f, (_, _, _, b, k, *_)) in enumerate(zip(world.facings, world.facings_i, strict=True)):
        lo, hi, facing, base = world.blocks[b, :3], world.blocks[b, 3:], world.blocks_i[b, 1], world.levels[k, 1]
        deep = (hi - lo)[1 if facing < 2 else 0]
        for n, (front, bottom, top) in enumerate(((f[4], base, f[5]), (f[6], f[5], f[7]))):
            u, w = np.array([f[2], f[3]]), np.array([front, deep])
            x = (lo[0] + u, hi[0] - u, lo[0] + w, hi[0] - w)[facing]
            y = (lo[1] + w, hi[1] - w, hi[1] - u, lo[1] + u)[facing]
            out[n, c] = min(x), min(y), bottom, max(x), max(y), top
    return out.reshape(-1, 6)


@pytest.mark.parametrize("fill", [1.0, 0.2])
def test_shelf_traversal_finds_the_same_hits_as_testing_every_box(fill: float) -> None:
    world = store() if fill == 1 else build_world(dataclasses.replace(SMALL, fill=fill), seed=3)
    assert fill == 1 or len(world.facings) < 0.4 * len(store().facings)
    boxes = product_boxes(world)
    boxes = boxes[boxes[:, 5] > boxes[:, 2]]
    r = Renderer(world, make_rig("fisheye", (106, 100)))
    for pose in (POSE, pose_at(6.5, SMALL.aisle_y(1), -2.4, 0.3)):
        view = r.view(0, pose)
        shown = np.flatnonzero(view.ids.ravel() >= 0)[::9]
        rays = r.cameras[0].grid.reshape(-1, 3)[shown] @ pose[:3, :3].T
        with np.errstate(divide="ignore"):
            a, b = ((boxes[None, :, i : i + 3] - pose[:3, 3]) / rays[:, None] for i in (0, 3))
        enter, leave = np.minimum(a, b).max(2), np.maximum(a, b).min(2)
        nearest = np.where((enter < leave) & (enter > 0), enter, np.inf).min(1)
        found, product = view.depth.ravel()[shown], kind_of(view).ravel()[shown] == FACING
        assert product.mean() > (0.2 if fill == 1 else 0.02)
        assert np.allclose(found[product], nearest[product], rtol=1e-6, atol=1e-6)
        assert (found[~product] < nearest[~product] + 1e-5).all()


@pytest.mark.parametrize("camera", sorted(CAMERAS))
def test_both_cameras_see_the_same_points(camera: str) -> None:
    """A left pixel's point, projected by the exact model, is seen by the right camera there: depths agree."""
    r = renderer(camera)
    left, right = r.render(POSE)
    rig: Rig = r.rig
    assert rig.right is not None
    points = se3.transform(se3.inverse(rig.left_T_right), r.cameras[0].grid * left.depth[..., None])
    uv = rig.right.project(points)
    ok = rig.right.inside(uv, 2)
    near = np.round(uv[ok]).astype(int)
    same = right.ids[near[:, 1], near[:, 0]] == left.ids[ok]
    assert same.mean() > 0.8
    # On a plane the inverse distance along rays through neighbouring pixels is nearly linear: interpolate it.
    inverse = look_up(np.nan_to_num(1 / right.depth), uv)
    error = np.abs(inverse[ok] * np.linalg.norm(points[ok], axis=1) - 1)[same]
    assert np.median(error) < 1e-4
    # Brightness agrees too: lights, textures and filters do not depend on the camera.
    warped = look_up(right.image, uv)
    step = np.abs(warped - left.image)[ok][same]
    assert np.median(step) < 1.0
    # Mean shift between the cameras, by flow from the exact prediction, along and across the epipolar line.
    shift = _mean_shift(left.image, right.image, left.ids, uv)
    assert np.abs(shift).max() < 0.03


def look_up(image: np.ndarray, uv: F64, how: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Image between its pixels, at uv (H, W, 2)."""
    x, y = (np.ascontiguousarray(uv[..., i], np.float32) for i in (0, 1))
    return cv2.remap(image.astype(np.float32), x, y, how)


def _mean_shift(a: np.ndarray, b: np.ndarray, ids: np.ndarray, uv: F64) -> F64:
    """Mean residual (2,) px of flow from image a to image b about predicted pixels, on single surfaces."""
    one, two = (np.clip(np.rint(i), 0, 255).astype(np.uint8) for i in (a, b))
    corners = np.asarray(cv2.goodFeaturesToTrack(one, 800, 0.004, 5)).reshape(-1, 2).astype(int)
    h, w = one.shape
    inside = (corners > 8).all(1) & (corners[:, 0] < w - 9) & (corners[:, 1] < h - 9)
    flat = [
        bool(i) and len(np.unique(ids[y - 4 : y + 5, x - 4 : x + 5])) == 1
        for (x, y), i in zip(corners, inside, strict=True)
    ]
    corners = corners[np.array(flat)]
    expected = uv[corners[:, 1], corners[:, 0]].astype(np.float32)
    good = np.isfinite(expected).all(1)
    start, expected = corners[good].astype(np.float32), expected[good]
    flags, stop = cv2.OPTFLOW_USE_INITIAL_FLOW, (3, 50, 1e-4)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        one, two, start.reshape(-1, 1, 2), expected.reshape(-1, 1, 2).copy(), None, None, (9, 9), 0, stop, flags
    )
    error = (np.asarray(found).reshape(-1, 2) - expected)[status.ravel() > 0]
    error = error[np.abs(error).max(1) < 0.5]
    assert len(error) > 60
    return error.mean(0)


def test_textures_do_not_crawl() -> None:
    """The next frame, warped by the ground truth, is this frame: textures are fixed to surfaces."""
    r = renderer("fisheye")
    after = POSE @ se3.exp(np.array([0.004, 0.003, 0.033, 0.002, 0.006, 0.001]))
    one, two = r.view(0, POSE), r.view(0, after)
    uv = r.rig.left.project(se3.transform(se3.inverse(after), hit_points(r, 0, one, POSE)))
    assert np.abs(_mean_shift(one.image, two.image, one.ids, uv)).max() < 0.02
    ok = r.rig.left.inside(uv, 2)
    warped = look_up(two.image, uv, cv2.INTER_CUBIC)
    step = np.abs(warped - one.image)[ok]
    assert np.median(step) < 0.7
    assert np.percentile(step, 90) < 8


def test_the_same_store_twice_and_exchanged_products() -> None:
    again = build_world(SMALL, seed=3)
    for a, b in zip(store(), again, strict=True):
        assert (a == b).all()
    changed = store(0.3)
    assert (changed.facings == store().facings).all()
    assert (changed.blocks == store().blocks).all()
    other = (changed.facings_i[:, 0] != store().facings_i[:, 0]).mean()
    assert 0.15 < other < 0.45
    assert len(store().facings) > 800


def test_identical_aisles_repeat_products_and_not_the_stock() -> None:
    world = build_world(Layout(gondolas=3, gondola_length=4.0, products=30, identical=True), seed=1)
    rows = [world.facings_i[:, 3] == b for b in range(len(world.blocks))]
    first, last = world.groups_i[0]
    for b in range(first, last):
        twin = b + last - first
        assert (world.facings_i[rows[b], :3] == world.facings_i[rows[twin], :3]).all()
        assert (world.facings[rows[b], :4] == world.facings[rows[twin], :4]).all()
    fronts = [world.facings[np.isin(world.facings_i[:, 3], np.arange(*world.groups_i[g])), 4] for g in (0, 1)]
    assert (fronts[0] != fronts[1]).mean() > 0.5


def board() -> tuple[U8, F64]:
    """A chessboard image (1024, 1024) of one metre, 8 x 8 squares, and its inner corners (49, 3)."""
    squares = (np.indices((8, 8)).sum(0) % 2 * 255).astype(np.uint8)
    at = np.arange(1, 8) / 8
    corners = np.stack(np.meshgrid(at, at), -1).reshape(-1, 2)
    return np.kron(squares, np.ones((128, 128), np.uint8)), np.column_stack([corners, np.zeros(49)])


@pytest.mark.parametrize("camera", ["fisheye", "distorted"])
def test_corners_of_a_board_are_where_the_model_projects_them(camera: str) -> None:
    picture, corners = board()
    rng, rig = np.random.default_rng(2), make_rig(camera)
    target = FlatTarget(picture, 1.0, 1.0, np.eye(4))
    world, moving = place(empty_room(), [target])
    r, world_T_cam, errors = Renderer(world, rig), pose_at(3, 5, 0, 0), list[F64]()
    assert rig.right is not None
    for _ in range(2):
        cam_T_board = se3.exp(np.concatenate([np.zeros(3), rng.uniform(-0.4, 0.4, 3)]))
        cam_T_board[:3, 3] = -0.5, -0.5, 0.9 if camera == "fisheye" else 1.3
        views = r.render(world_T_cam, move(moving, target, world_T_cam @ cam_T_board))
        assert (kind_of(views[0]) == TARGET).mean() > 0.05
        poses = (cam_T_board, se3.inverse(rig.left_T_right) @ cam_T_board)
        for lens, view, lens_T_board in zip((rig.left, rig.right), views, poses, strict=True):
            uv = lens.project(se3.transform(lens_T_board, corners))
            image = np.rint(np.clip(cv2.GaussianBlur(view.image, (0, 0), 1.0), 0, 255)).astype(np.uint8)
            start = uv.astype(np.float32).reshape(-1, 1, 2).copy()
            found = cv2.cornerSubPix(image, start, (5, 5), (-1, -1), (3, 60, 1e-4))
            errors.append((found.reshape(-1, 2) - uv)[lens.inside(uv, 10)])
    error = np.concatenate(errors)
    assert len(error) > 120
    assert np.sqrt((error**2).mean()) < 0.03  # what the corner finder itself leaves on exact images
    assert np.abs(error.mean(0)).max() < 0.006


def _flat_view(r: Renderer, value: float) -> View:
    view = r.view(0, POSE)
    return View(np.where(view.image > 0, value, 0).astype(np.float32), view.depth, view.ids)


def test_noise_has_the_stated_variance() -> None:
    r = renderer("pinhole")
    effects = Effects(exposure_s=0, lens_blur_px=0, gain=1, drift=0, vignetting=0, read_noise=1.5, shot_noise=0.05)
    sensor = Sensor(r.cameras[0], effects)
    for value in (20.0, 120.0):
        images = [sensor.expose(_flat_view(r, value), np.zeros(6), 1.0, key).astype(float) for key in (1, 2)]
        expected = 1.5**2 + 0.05 * value + 1 / 12
        assert images[0].mean() == pytest.approx(value + effects.black_level, abs=0.05)
        assert images[0].var() == pytest.approx(expected, rel=0.04)
        assert abs(np.corrcoef(images[0].ravel(), images[1].ravel())[0, 1]) < 0.015


def test_clean_sensor_only_rounds_and_blur_follows_the_motion() -> None:
    r = renderer("pinhole")
    view = r.view(0, POSE)
    plain = Sensor(r.cameras[0], CLEAN).expose(view, np.ones(6), 1.0, 5)
    assert (plain == np.clip(np.floor(view.image + 0.5), 0, 255)).all()
    sensor = Sensor(r.cameras[0], Effects(0.02, 0, 1.0, 0, 0, 0, 0, 0))
    assert (sensor.expose(view, np.zeros(6), 1.0, 5) == plain).all()
    turned = sensor.expose(view, np.array([0, 0, 0, 0, 1.0, 0]), 1.0, 5).astype(float)  # yaw: rows blur
    gradient = [[np.abs(np.diff(i.astype(float), axis=a)).mean() for a in (1, 0)] for i in (plain, turned)]
    assert gradient[1][0] < 0.65 * gradient[0][0]
    assert gradient[1][1] > 0.8 * gradient[0][1]
    # A blurred image is the mean of the sharp ones along the motion.
    steps = (np.arange(9) - 4) / 9 * 0.02
    sharp = [r.view(0, POSE @ se3.exp(np.array([0, 0, 0, 0, s, 0]))).image for s in steps]
    inner = np.s_[20:-20, 20:-20]
    assert np.abs(np.clip(np.mean(sharp, 0), 0, 255) - turned)[inner].mean() < 1.5


def test_people_move_and_the_store_does_not() -> None:
    people = crowd(SMALL, 6, np.random.default_rng(0))
    world = store()
    moved = [moving(world, crowd_at(people, t)) for t in (0.0, 1.0)]
    shift = np.linalg.norm(moved[1].persons[:, :2] - moved[0].persons[:, :2], axis=1)
    assert (shift > 0.2).all() and (shift < 1.6).all()
    alone = moving(world, crowd_at(people[:1], 0.0))
    at = alone.persons[0]
    viewpoint = pose_at(0.5 * (at[0] + at[3]) - 2.0, 0.5 * (at[1] + at[4]), 0.0)
    r = renderer("pinhole")
    with_one, without = r.view(0, viewpoint, alone), r.view(0, viewpoint)
    shown = kind_of(with_one) == PERSON
    assert 0.01 < shown.mean() < 0.5
    points = hit_points(r, 0, with_one, viewpoint)[shown]
    assert (points > at[:3] - 1e-6).all() and (points < at[3:] + 1e-6).all()
    far = cv2.dilate(shown.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    assert (with_one.image == without.image)[far].all()


def test_more_rays_through_a_pixel_come_near_to_exact_images() -> None:
    rig = make_rig("pinhole", (320, 200))
    one, four, exact = (Renderer(store(), rig, rays).view(0, POSE) for rays in (1, 4, 6))
    assert np.array_equal(one.depth, four.depth) and np.array_equal(one.ids, four.ids)
    shown = exact.ids >= 0
    error = [float(np.abs(view.image - exact.image)[shown].mean()) for view in (one, four)]
    assert error[0] > 2 and error[1] < 0.3 * error[0]
    assert abs(float((one.image - exact.image)[shown].mean())) < 1  # nothing is brighter or darker for it


def test_with_more_rays_an_edge_inside_a_texture_lies_where_it_is() -> None:
    """Texture windows of a shelf's front against their exact places: by least squares of brightness."""
    rig = make_rig("pinhole", (320, 200))
    one, four, exact = (Renderer(store(), rig, rays).view(0, POSE).image for rays in (1, 4, 8))
    corners = cv2.goodFeaturesToTrack(np.clip(exact, 0, 255).astype(np.uint8), 300, 0.01, 6)[:, 0]
    shifts = [_shifts(image, exact, corners) for image in (one, four)]
    rms = [float(np.sqrt(np.mean(np.square(shift)))) for shift in shifts]
    assert rms[0] > 0.03 and rms[1] < 0.5 * rms[0]


def _shifts(image: F64, exact: F64, corners: F64) -> F64:
    """(N, 2) px by which windows around corners (N, 2) px are displaced."""
    smooth, true = (cv2.GaussianBlur(a.astype(np.float32), (0, 0), 0.7) for a in (image, exact))
    dy, dx = np.gradient(true)
    out = list[F64]()
    for u, v in corners.astype(int):
        rows, columns = slice(v - 6, v + 7), slice(u - 6, u + 7)
        if min(u, v) < 6 or v > true.shape[0] - 8 or u > true.shape[1] - 8:
            continue
        a, b, x, y = (part[rows, columns].ravel() for part in (true, smooth, dx, dy))
        solution = np.linalg.lstsq(np.column_stack([x, y, np.ones(len(a)), a]), a - b, rcond=None)[0]
        out.append(np.clip(solution[:2], -0.5, 0.5))
    return np.array(out)
