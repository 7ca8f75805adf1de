"""Round goods, mirrors and glass of the simulator against independent geometry."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest

from stereo_sfm.drivers.sim.drives import FORWARD
from stereo_sfm.drivers.sim.fittings import materials
from stereo_sfm.drivers.sim.kernels import BOTTLE, CAN, FACING, LID, NARROW, NECK, ROOM, ROUND, SHOULDER
from stereo_sfm.drivers.sim.optics import CLEAR, FLOOR, GLASS, PASSES, POLISH, ROUGH, STRAIGHT
from stereo_sfm.drivers.sim.render import Renderer, View
from stereo_sfm.drivers.sim.rigs import make_rig
from stereo_sfm.drivers.sim.shelves import Mix
from stereo_sfm.drivers.sim.tables import Tables
from stereo_sfm.drivers.sim.targets import FlatTarget, empty_room, place
from stereo_sfm.drivers.sim.world import Layout, build_world
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

SMALL = Layout(gondolas=1, gondola_length=4.0, products=30, gaps=0.2, mix=Mix(round=1.0, clear=0.5, glossy=0.5))


@functools.cache
def round_store() -> Tables:
    return build_world(SMALL, seed=2)


def looking(x: float, y: float, z: float, heading: float) -> F64:
    pose = np.eye(4)
    pose[:3, :3] = se3.so3_exp(np.array([0, 0, heading])) @ FORWARD
    pose[:3, 3] = x, y, z
    return pose


def bodies(world: Tables) -> F64:
    """(N, 7) of every can and bottle: axis x, y; z from, z to, radius, form, its facing."""
    rows: list[list[float]] = []
    for c, f in enumerate(world.facings):
        b, k, form, _ = world.facings_i[c, 3:]
        lo, hi, facing = world.blocks[b, :3], world.blocks[b, 3:], world.blocks_i[b, 1]
        deep, radius = (hi - lo)[1 if facing < 2 else 0], 0.5 * (f[3] - f[2])
        for front, low, high in ((f[4], world.levels[k, 1], f[5]), (f[6], f[5], f[7])):
            for n in range(max(1, int((deep - front) / (2 * radius))) if high > low else 0):
                u, w = f[2] + radius, front + (2 * n + 1) * radius
                x = (lo[0] + u, hi[0] - u, lo[0] + w, hi[0] - w)[facing]
                y = (lo[1] + w, hi[1] - w, hi[1] - u, lo[1] + u)[facing]
                rows.append([x, y, low, high, radius, form, c])
    return np.array(rows)


def radius_at(body: F64, z: F64) -> F64:
    """Radius of bodies (..., 7) at heights (...), 0 above and below them."""
    rise = (z - body[..., 2]) / (body[..., 3] - body[..., 2])
    shoulder = 1 + (np.clip(rise, SHOULDER, NECK) - SHOULDER) / (NECK - SHOULDER) * (NARROW - 1)
    r = np.where(body[..., 5] == BOTTLE, shoulder, 1.0) * body[..., 4]
    return np.where((rise >= 0) & (rise <= 1), r, 0.0)


@pytest.mark.parametrize("height", [0.7, 1.3, 1.9])
def test_rays_end_on_round_goods_and_never_pass_through_them(height: float) -> None:
    world, pose = round_store(), looking(4.2, SMALL.aisle_y(0), height, 1.2)
    r = Renderer(world, make_rig("fisheye", (106, 100)))
    view, things = r.view(0, pose), bodies(world)
    assert {CAN, BOTTLE} == set(things[:, 5].astype(int).tolist())
    shown = np.flatnonzero(view.ids.ravel() >= 0)[::29]
    rays = r.cameras[0].grid.reshape(-1, 3)[shown] @ pose[:3, :3].T
    ended = 0
    for p, ray in zip(shown.tolist(), rays, strict=True):
        t, hit = float(view.depth.ravel()[p]), int(view.ids.ravel()[p])
        flat = ray[:2] / max(float(np.linalg.norm(ray[:2])), 1e-9)
        beside = np.abs((things[:, 0] - pose[0, 3]) * flat[1] - (things[:, 1] - pose[1, 3]) * flat[0])
        close = things[beside < 0.08]
        at = pose[:3, 3] + np.arange(0.002, t - 2e-3, 0.002)[:, None] * ray
        gap = np.linalg.norm(at[:, None, :2] - close[None, :, :2], axis=2) - radius_at(close[None], at[:, None, 2])
        assert gap.min(initial=1.0) > -2e-4  # nothing round in front of the hit
        if (hit >> 4) & 7 == FACING:
            end = pose[:3, 3] + t * ray
            body = close[close[:, 6] == hit >> 12]
            side = np.abs(np.linalg.norm(end[:2] - body[:, :2], axis=1) - radius_at(body, end[2])).min()
            lid = np.abs(end[2] - body[:, 2:4]).min()
            assert (side if hit & 3 == ROUND else lid) < 1e-5
            assert hit & 3 in (ROUND, LID)
            ended += 1
    assert ended > 30


def mirror_room(shine: dict[int, dict[int, float]], panes: list[list[float]]) -> Tables:
    """An empty room with these entries of `materials`."""
    table = np.array(materials(1.0, True))
    for row, columns in shine.items():
        for column, value in columns.items():
            table[row, column] = value
    return empty_room()._replace(materials=table, panes=np.array(panes, float).reshape(-1, 6))


PERFECT = {STRAIGHT: 1.0, POLISH: 1.0, ROUGH: 0.0}


@pytest.mark.parametrize("mirror", ["floor", "pane"])
@pytest.mark.parametrize("side", [0, 1])
def test_a_mirror_image_is_where_the_mirrored_thing_would_be(mirror: str, side: int) -> None:
    squares = (np.indices((8, 8)).sum(0) % 2 * 255).astype(np.uint8)
    board = np.kron(squares, np.ones((64, 64), np.uint8))
    rig, pose, placed = make_rig("fisheye"), looking(3, 5, 1.3, 0.0), np.eye(4)
    assert rig.right is not None
    if mirror == "floor":
        room, flip = mirror_room({FLOOR: PERFECT}, []), np.diag([1, 1, -1.0])
        placed[:3, 3] = -0.5, -0.2, 1.4
    else:
        room = mirror_room({FLOOR: {POLISH: 0.0}, GLASS: PERFECT | {PASSES: 0.0}}, [[3, 6.2, 0.1, 9, 6.2, 3]])
        flip = np.diag([1, -1.0, 1])
        placed[:3, 3] = -0.6, -0.5, 1.2
    world_T_board = pose @ placed
    world, moving = place(room, [FlatTarget(board, 1.0, 1.0, world_T_board)])
    view = Renderer(world, rig).view(side, pose if side == 0 else pose @ rig.left_T_right, moving)
    at = np.arange(1, 8) / 8
    corners = np.column_stack([np.stack(np.meshgrid(at, at), -1).reshape(-1, 2), np.zeros(49)])
    virtual = se3.transform(world_T_board, corners) @ flip + (0 if mirror == "floor" else np.array([0, 2 * 6.2, 0]))
    lens_T_world = se3.inverse(pose if side == 0 else pose @ rig.left_T_right)
    lens = (rig.left, rig.right)[side]
    uv = lens.project(se3.transform(lens_T_world, virtual))
    near = np.rint(uv).astype(int)
    seen = lens.inside(uv, 12)
    kinds = (view.ids[near[seen, 1], near[seen, 0]] >> 4) & 7
    seen[seen] = kinds == ROOM  # its mirror image, not the board itself
    assert seen.sum() > 15
    image = np.rint(np.clip(cv2.GaussianBlur(view.image, (0, 0), 1.0), 0, 255)).astype(np.uint8)
    start = uv[seen].astype(np.float32).reshape(-1, 1, 2).copy()
    found = cv2.cornerSubPix(image, start, (3, 3), (-1, -1), (3, 60, 1e-4)).reshape(-1, 2)
    error = found - uv[seen]
    assert np.median(np.linalg.norm(error, axis=1)) < 0.1
    assert np.abs(np.median(error, axis=0)).max() < 0.03


def test_mirrors_change_brightness_and_neither_depth_nor_surfaces() -> None:
    layout = Layout(gondolas=1, gondola_length=4.0, products=30, mix=Mix(glossy=1.0), glass=0.5, polish=1.0)
    world, rig = build_world(layout, seed=2), make_rig("fisheye", (212, 200))
    pose = looking(4.2, layout.aisle_y(0), 1.3, 0.4)
    shiny = Renderer(world, rig).view(0, pose)
    matt = Renderer(world._replace(materials=world.materials[:0]), rig).view(0, pose)
    assert np.array_equal(shiny.depth, matt.depth, equal_nan=True)
    assert np.array_equal(shiny.ids, matt.ids)
    floor = shiny.ids == 0
    lamps = (shiny.image - matt.image)[floor]
    assert (lamps > 60).mean() > 0.005 and np.median(lamps) < 10
    again = Renderer(world, rig).view(0, pose)
    assert np.array_equal(again.image, shiny.image)


def test_clear_goods_show_what_is_behind_them() -> None:
    world, pose = round_store(), looking(4.2, SMALL.aisle_y(0), 1.3, 1.2)
    rig = make_rig("fisheye", (212, 200))
    opaque = world.materials.copy()
    opaque[CLEAR, PASSES] = 0.0
    one, two = (Renderer(world._replace(materials=m), rig).view(0, pose) for m in (world.materials, opaque))
    changed = np.abs(one.image - two.image) > 5
    product = (one.ids >= 0) & ((one.ids >> 4) & 7 == FACING)
    clear = np.zeros_like(product)
    clear[product] = world.facings_i[one.ids[product] >> 12, 6] == CLEAR
    assert changed[clear].mean() > 0.2
    near = cv2.dilate(clear.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert not changed[~near].any()


def test_stock_densities_are_options() -> None:
    layout = Layout().with_stock({"gaps": 0.4, "round": 0.5, "carts": 3})
    assert (layout.gaps, layout.mix.round, layout.carts, layout.fill) == (0.4, 0.5, 3, 1.0)
    assert Layout().with_stock({}) == Layout()
    assert not len(build_world(Layout(gondolas=1, gondola_length=3.0, products=20), seed=1).materials)


def points_of(r: Renderer, view: View, pose: F64) -> F64:
    return se3.transform(pose, r.cameras[0].grid * view.depth[..., None])


def test_goods_hang_below_the_board_above() -> None:
    layout = Layout(gondolas=1, gondola_length=4.0, products=30, mix=Mix(hanging=1.0))
    world = build_world(layout, seed=2)
    k = world.facings_i[:, 4]
    filled = world.facings[:, 7] > world.facings[:, 5]
    assert filled.mean() > 0.9
    assert np.allclose((world.levels[k, 2] - world.facings[:, 7])[filled], 0.015)
    r, pose = Renderer(world, make_rig("fisheye", (106, 100))), looking(4.2, layout.aisle_y(0), 1.3, 1.2)
    view = r.view(0, pose)
    shown = (view.ids >= 0) & ((view.ids >> 4) & 7 == FACING)
    c = view.ids[shown] >> 12
    z = points_of(r, view, pose)[shown][:, 2]
    assert shown.sum() > 500
    assert (z > world.facings[c, 5] - 1e-5).all() and (z < world.facings[c, 7] + 1e-5).all()
