"""Points found again from a distant pose: deformation of windows by planes, and the search for them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_sfm.drivers.sim.rigs import make_rig
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.reappearance import find_deformed, plane_warps, surfaces_around
from stereo_sfm.types import F64

CAMERA = make_rig("fisheye", (424, 400)).left
MOVED = se3.exp(np.array([0.02, -0.01, 0.8, 0.01, 0.05, 0.0]))  # old_T_new


def on_plane(uv: F64, axis: int, at: float) -> F64:
    """(N, 3) where the rays of pixels (N, 2) meet the plane whose coordinate `axis` is `at`."""
    rays = CAMERA.unproject(uv)
    return rays * (at / rays[:, axis])[:, None]


@pytest.mark.parametrize(
    ("axis", "at", "uv"), [(0, 1.2, (330.0, 210.0)), (1, 1.5, (190.0, 330.0)), (2, 4.0, (250.0, 170.0))]
)
def test_the_deformation_of_a_plane_is_that_of_its_images(axis: int, at: float, uv: tuple[float, float]) -> None:
    middle = np.array([uv])
    offsets = np.array([[3.0, 0.0], [0.0, 3.0], [-2.0, 2.0]])
    new_T_old = se3.inverse(MOVED)
    warp = plane_warps(CAMERA, surfaces_around(CAMERA, middle, on_plane(middle, axis, at)), new_T_old)[axis, 0]
    seen = CAMERA.project(se3.transform(new_T_old, on_plane(middle + offsets, axis, at)))
    centre = CAMERA.project(se3.transform(new_T_old, on_plane(middle, axis, at)))
    assert np.abs(seen - centre - offsets @ warp.T).max() < 0.35  # of 4 to 9 px
    assert np.linalg.norm(warp, 2) > 1.2


def test_surfaces_seen_too_obliquely_and_too_large_changes_are_left_out() -> None:
    ahead = np.array([[CAMERA.cx + 5.0, CAMERA.cy]])
    points = 4.0 * CAMERA.unproject(ahead)
    around = surfaces_around(CAMERA, ahead, points)
    warps = plane_warps(CAMERA, around, np.eye(4))
    assert np.isnan(warps[:2]).all()
    assert warps[2, 0] == pytest.approx(np.eye(2), abs=1e-3)
    near = se3.from_rotation_translation(np.eye(3), np.array([0.0, 0.0, -3.2]))  # five times as near
    assert np.isnan(plane_warps(CAMERA, around, near)).all()


def test_a_magnified_window_is_found_far_from_where_it_is_predicted() -> None:
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (200, 200)), (0, 0), 2.0)
    texture = (255 * (texture - texture.min()) / np.ptp(texture)).astype(np.uint8)
    scale, shift = 1.7, np.array([-40.0, -55.0])
    matrix = np.column_stack([scale * np.eye(2), shift])
    pyramid = klt.build_pyramid(texture, 4)
    seen = klt.build_pyramid(np.asarray(cv2.warpAffine(texture, matrix, (200, 200)), np.uint8), 4)
    uv = rng.uniform(70, 120, (12, 2))
    store = klt.Appearances.empty(12)
    klt.make_patches(pyramid[0], uv, np.arange(12), store, klt.WEIGHTS, klt.COORDINATES)
    true = uv * scale + shift
    guess = true + rng.uniform(-20, 20, (12, 2))
    warps = np.tile(np.stack([np.eye(2), scale * np.eye(2), np.full((2, 2), np.nan)])[:, None], (1, 12, 1, 1))
    found, warp = np.full((12, 2), np.nan), np.zeros((12, 2, 2))
    ncc = find_deformed(seen[1], guess, warps, np.arange(12), store.patch, 14, 1, found, warp)
    near = np.linalg.norm(found - true, axis=1) < 2.0
    assert near.mean() > 0.8
    assert ncc[near].min() > 0.7
    assert (warp[near] == scale * np.eye(2)).all()
