"""Depth of a pair: exact disparities of rendered planes, standard deviations, geometry of every kind of view."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.dense.depth import disparities, pair_depth
from stereo_sfm.dense.matching import match_both_ways
from stereo_sfm.dense.refinement import refine
from stereo_sfm.dense.surface_mean import surface_means
from stereo_sfm.dense.views import PairView, motion_view, stereo_view
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import F64, U8
from tests.synthetic import fisheye_rig, pinhole_rig


def texture(seed: int = 3) -> U8:
    noise = np.random.default_rng(seed).uniform(0, 255, (1200, 1200)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return cv2.normalize(smooth, np.empty(0), 10, 245, cv2.NORM_MINMAX).astype(np.uint8)


def render(camera: Camera, world_T_cam: F64, planes: list[tuple[int, float]]) -> tuple[U8, F64]:
    """Textured walls across the axes (axis, place in metres) as a camera sees them, and the ranges."""
    rays = camera.bearing_grid() @ world_T_cam[:3, :3].T
    best, image = np.full(rays.shape[:2], np.inf), np.zeros(rays.shape[:2], np.uint8)
    for number, (axis, place) in enumerate(planes):
        with np.errstate(divide="ignore", invalid="ignore"):
            r = (place - world_T_cam[axis, 3]) / rays[..., axis]
            p = world_T_cam[:3, 3] + rays * r[..., None]
        others = [k for k in range(3) if k != axis]
        uv = np.nan_to_num((p[..., others] * 120 + 600), nan=0, posinf=0, neginf=0).astype(np.float32)
        seen = cv2.remap(texture(number), uv[..., 0], uv[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        nearer = (r > 0) & (r < best)
        image[nearer], best[nearer] = seen[nearer], r[nearer]
    return image, best


def truth_of(view: PairView, world_T_cam: F64, planes: list[tuple[int, float]]) -> F64:
    turned = world_T_cam @ se3.from_rotation_translation(view.cam_R_view, np.zeros(3))
    return render(view.camera, turned, planes)[1]


@pytest.mark.parametrize("rig", [pinhole_rig(), fisheye_rig()], ids=["pinhole", "fisheye"])
def test_a_pair_finds_walls_ahead_and_beside(rig: Rig) -> None:
    planes = [(2, 2.0), (0, -1.2), (0, 1.3)]
    left, _ = render(rig.left, np.eye(4), planes)
    right, _ = render(rig.right, rig.left_T_right, planes)
    view = stereo_view(rig, 0.5)
    depth = pair_depth(view, left, right)
    error = np.abs(depth.ranges / truth_of(view, np.eye(4), planes) - 1)
    known = np.isfinite(depth.ranges)
    assert known.mean() > 0.5
    assert np.median(error[known]) < 0.01


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_what_a_mask_covers_has_no_depth(scale: float) -> None:
    """The robot's own tray, at any resolution of the view, by a pair and by motion."""
    used = np.ones((480, 640), bool)
    used[360:] = False
    rig = replace(pinhole_rig(), left_mask=used)
    ahead = se3.exp(np.array([0.01, 0.0, 0.25, 0.0, 0.02, 0.0]))
    for view in (stereo_view(rig, scale), motion_view(rig, rig, ahead, scale * rig.left.fx)):
        assert view is not None
        uv = rig.left.project(view.camera.bearing_grid() @ view.cam_R_view.T)
        inside = rig.left.inside(uv)
        assert not view.first.mask[inside & (uv[..., 1] > 362)].any()
        assert view.first.mask[inside & (uv[..., 1] < 358)].mean() > 0.9


def test_two_keyframes_straight_ahead_are_a_pair() -> None:
    """The epipole is in the middle of the image: no pinhole rectification exists."""
    rig = fisheye_rig()
    planes = [(0, -1.2), (0, 1.3), (2, 4.0)]
    ahead = se3.exp(np.array([0.01, 0.0, 0.25, 0.0, 0.02, 0.0]))
    images = [render(rig.left, pose, planes)[0] for pose in (np.eye(4), ahead)]
    view = motion_view(rig, rig, ahead, 0.5 * rig.left.fx)
    assert view is not None
    depth = pair_depth(view, *images)
    truth = truth_of(view, np.eye(4), planes)
    near = np.isfinite(depth.ranges) & (truth < 2.5)
    assert near.sum() > 2000
    assert np.median(np.abs(depth.ranges / truth - 1)[near]) < 0.01


def test_disparities_are_finer_than_the_matchers_and_know_how_fine() -> None:
    shift = 6.3 + 0.04 * np.arange(300, dtype=np.float32)[None, :].repeat(200, 0)
    u, v = np.meshgrid(np.arange(300, dtype=np.float32), np.arange(200, dtype=np.float32))
    big = texture()
    rng = np.random.default_rng(1)
    right = cv2.remap(big, u + 100, v + 100, cv2.INTER_CUBIC)
    left = cv2.remap(big, u - shift + 100, v + 100, cv2.INTER_CUBIC)
    noisy = [np.clip(i + rng.normal(0, 2, i.shape), 0, 255).astype(np.uint8) for i in (left, right)]
    found, sigma = disparities(noisy[0], noisy[1], 32)
    error = np.abs(found - shift)
    known = np.isfinite(found)
    assert known.mean() > 0.8
    matched = np.abs(match_both_ways(noisy[0], noisy[1], 32)[0] - shift)[known]
    assert np.median(error[known]) < 0.8 * np.nanmedian(matched)
    assert 0.5 < (error <= sigma)[known].mean() < 0.85  # what all windows share is not in it
    again = disparities(noisy[0], noisy[1], 32)
    np.testing.assert_array_equal(again[0], found)


def test_windows_with_hardly_any_texture_are_known_from_those_around_and_steps_stay() -> None:
    """A floor of faint texture beside a box 3 px nearer: what a window does not know, its surface does."""
    rng = np.random.default_rng(4)
    v, u = np.mgrid[0:120, 0:160].astype(np.float32)
    plane = 6.2 + 0.015 * u - 0.02 * v
    shift = np.where(u < 80, plane, plane + 3).astype(np.float32)
    sigma = np.where(v < 60, 0.3, 0.03).astype(np.float32)
    found = (shift + rng.normal(0, sigma)).astype(np.float32)
    mean, spread = surface_means(found, sigma)
    error, before = np.abs(mean - shift), np.abs(found - shift)
    for part in (v < 48, v > 72):
        for side in (u < 80, u >= 80):
            assert np.median(error[part & side]) < 0.5 * np.median(before[part & side])
    assert 0.6 < (error <= spread).mean() < 0.85
    # a pixel with texture amid others without keeps its own
    lone = np.full((60, 60), 0.3, np.float32)
    lone[30, 30] = 0.01
    bent = np.full((60, 60), 5.0, np.float32)
    bent[30, 30] = 5.2
    assert abs(surface_means(bent, lone)[0][30, 30] - 5.2) < 0.01


def test_nothing_is_found_where_there_is_no_texture() -> None:
    flat = np.full((100, 160), 90, np.uint8)
    assert not np.isfinite(disparities(flat, flat, 16)[0]).any()


def test_a_coarser_grid_has_the_same_disparities_at_its_pixels() -> None:
    big = texture()
    left, right = np.ascontiguousarray(big[100:143, 100:181]), np.ascontiguousarray(big[100:143, 105:186])
    start = np.full(left.shape, 5.2, np.float32)
    fine, coarse = (refine(left, right, start, step) for step in (1, 2))
    assert np.isfinite(coarse[0]).sum() > 300
    for whole, part in zip(fine, coarse, strict=True):
        np.testing.assert_array_equal(whole[::2, ::2], part)


def test_a_view_of_every_second_pixel_has_the_same_ranges() -> None:
    for rig in (pinhole_rig(), fisheye_rig()):
        view = stereo_view(rig, 0.3)
        disparity = np.full((view.camera.height, view.camera.width), 4.0, np.float32)
        coarse = view.every(2).ranges(np.asarray(disparity[::2, ::2] / 2, np.float32))
        np.testing.assert_allclose(coarse, view.ranges(disparity)[::2, ::2], rtol=1e-5)
