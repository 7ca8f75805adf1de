"""Flow against images whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import KannalaBrandt
from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.coarse_rotation import CoarseRotation
from stereo_sfm.tracking.flow.corners import detect_corners
from stereo_sfm.types import F64, U8, Bool


def texture(seed: int, height: int = 240, width: int = 320) -> U8:
    """Noise of every scale above two pixels: corners everywhere."""
    noise = np.random.default_rng(seed).normal(size=(height, width))
    smooth = sum(sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (1.6, 6.0, 20.0))
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def grid(image: U8, step: int = 24, border: int = 40) -> F64:
    v, u = np.mgrid[border : image.shape[0] - border : step, border : image.shape[1] - border : step]
    return np.stack([u.ravel(), v.ravel()], 1).astype(float)


def warp(image: U8, matrix: F64) -> U8:
    return cv2.warpAffine(image, matrix, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.3, -2.7), (17.25, 9.5)])
@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.6, 15.0)])
def test_translation_is_found_to_a_twentieth_of_a_pixel(shift: tuple[float, float], gain: float, offset: float) -> None:
    image = texture(1)
    moved = warp(image, np.array([[1, 0, shift[0]], [0, 1, shift[1]]], float))
    moved = np.clip(gain * moved + offset, 0, 255).astype(np.uint8)
    uv = grid(image)
    pyramids = klt.build_pyramid(image, 4), klt.build_pyramid(moved, 4)
    out, alike = (klt.track_translation(*pyramids, uv, uv, 3, 0, 2.0, ncc, klt.WEIGHTS) for ncc in (0.6, 0.98))
    found = np.isfinite(out[:, 0])
    assert found.mean() > 0.8  # the rest lies where the border was reflected
    assert np.median(np.linalg.norm(out - uv - shift, axis=1)[found]) < 0.07  # both images are interpolated
    assert np.isfinite(alike[:, 0]).sum() > 0.5 * found.sum()


def aligned(image: U8, seen: U8, uv: F64, start: F64) -> tuple[F64, F64, Bool]:
    """First appearances at `uv` of one image found in another: pixels, deformations, and which were found."""
    n, slots = len(uv), np.arange(len(uv))[::-1].copy()
    store = klt.Appearances.empty(n)
    good = klt.make_patches(klt.build_pyramid(image, 1)[0], uv, slots, store, klt.WEIGHTS, klt.COORDINATES)
    out, deformation = start.copy(), np.tile(np.eye(2), (n, 1, 1))
    pixels = klt.build_pyramid(seen, 1)[0]
    flat = np.zeros((n, 6))
    ncc = klt.track_affine(pixels, out, deformation, flat, slots, good, store, 15, klt.WEIGHTS, klt.COORDINATES)
    return out, deformation, good & (ncc > 0.95)


def test_in_a_darker_image_every_window_is_aligned() -> None:
    """Each window's contrast is raised to that of its first appearance: nothing may add up from window to window."""
    image = texture(1)
    uv = np.repeat(grid(image, 12), 4, axis=0)
    darker = np.clip(0.4 * image.astype(float), 0, 255).astype(np.uint8)
    out, _, found = aligned(image, darker, uv, uv + np.array([0.6, -0.4]))
    assert len(uv) > 800
    assert found.all()
    assert np.linalg.norm(out - uv, axis=1).max() < 0.2


def test_affine_alignment_finds_the_deformation() -> None:
    image, matrix = texture(2), np.array([[1.04, 0.05, -4.0], [-0.03, 0.97, 3.0]])
    uv = grid(image)
    truth = uv @ matrix[:, :2].T + matrix[:, 2]
    start = truth + np.random.default_rng(0).normal(size=truth.shape) * 0.5
    out, deformation, found = aligned(image, warp(image, matrix), uv, start)
    assert found.mean() > 0.8  # the rest lies where the border was reflected
    assert np.median(np.linalg.norm(out - truth, axis=1)[found]) < 0.05
    assert np.abs(np.median(deformation[found], 0) - matrix[:, :2]).max() < 0.01


def test_affine_alignment_does_not_depend_on_its_start() -> None:
    """A remaining part of the initial error would bias the motion if all points start short of it."""
    image, matrix = texture(2), np.array([[1.02, 0.01, -2.4], [-0.01, 1.02, -1.8]])
    uv = grid(image)
    truth = uv @ matrix[:, :2].T + matrix[:, 2]
    seen = warp(image, matrix)
    off = np.array([0.2, 0.1])
    short, _, found = aligned(image, seen, uv, truth + off)
    far, _, found_far = aligned(image, seen, uv, truth - off)
    both = found & found_far
    assert both.mean() > 0.8
    assert np.abs(np.median((short - far)[both], axis=0)).max() < 0.003


def test_a_warped_window_is_the_bilinear_interpolation_up_to_the_border() -> None:
    image = np.random.default_rng(0).integers(0, 256, (90, 120)).astype(np.uint8)
    rng = np.random.default_rng(1)
    n = 4000
    centre = rng.uniform([-5, -5], [125, 95], (n, 2))
    warps = np.eye(2) + rng.normal(0, 0.3, (n, 2, 2))
    offset = klt.COORDINATES.reshape(3, klt.SIZE, klt.STRIDE)[:2, :, : klt.SIZE].reshape(2, -1)
    u, v = np.moveaxis(warps @ offset + centre[:, :, None], 1, 0)
    reach = klt.HALF * np.abs(warps).sum(2)  # of the corners of the window, and no further
    inside = ((centre - reach >= 0) & (centre + reach < [120 - 1.001, 90 - 1.001])).all(1)
    assert 0.2 < inside.mean() < 0.8
    windows = rng.normal(size=u.shape)
    for row in np.flatnonzero(inside):
        iu, iv = np.floor(u[row]).astype(int), np.floor(v[row]).astype(int)
        fu, fv = u[row] - iu, v[row] - iv
        four = [image[iv + dv, iu + du].astype(float) for dv in (0, 1) for du in (0, 1)]
        windows[row] = (1 - fv) * ((1 - fu) * four[0] + fu * four[1]) + fv * ((1 - fu) * four[2] + fu * four[3])
    weights = klt.WEIGHTS.reshape(klt.SIZE, klt.STRIDE)[:, : klt.SIZE].ravel().astype(float)
    windows -= (windows @ weights)[:, None]
    patch = np.zeros((n, klt.SIZE, klt.STRIDE), np.float32)
    patch[:, :, : klt.SIZE] = windows.reshape(n, klt.SIZE, klt.SIZE)
    store = klt.Appearances.empty(n)  # no gradients: a step of zero
    store.patch[:], store.contrast[:] = patch.reshape(n, -1), np.sqrt(windows**2 @ weights)
    ncc = klt.track_affine(
        klt.build_pyramid(image, 1)[0], centre.copy(), warps.copy(), np.zeros((n, 6)), np.arange(n), np.ones(n, bool),
        store, 1, klt.WEIGHTS, klt.COORDINATES,
    )  # fmt: skip
    assert (ncc[~inside] == 0).all()
    assert ncc[inside].min() > 0.9999


def test_a_different_window_is_rejected() -> None:
    image, other = texture(3), texture(4)
    uv = grid(image)
    out = klt.track_translation(
        klt.build_pyramid(image, 3), klt.build_pyramid(other, 3), uv, uv, 2, 0, 2.0, 0.85, klt.WEIGHTS
    )
    assert np.isfinite(out).mean() < 0.05


@pytest.mark.parametrize("value", [0, 127, 255])
def test_a_flat_image_has_no_points(value: int) -> None:
    flat = np.full((240, 320), value, np.uint8)
    uv = grid(flat)
    pyramid = klt.build_pyramid(flat, 3)
    assert np.isnan(klt.track_translation(pyramid, pyramid, uv, uv, 2, 0, 2.0, 0.6, klt.WEIGHTS)).all()
    mask = np.ones((120, 160), bool)
    assert len(detect_corners(pyramid[1], mask, np.zeros((0, 2)), 100, 16.0, 0.01)) == 0


def test_nan_and_outside_are_refused() -> None:
    pyramid = klt.build_pyramid(texture(5), 3)
    uv = np.array([[100.0, 100.0], [1.0, 1.0], [150.0, 90.0]])
    guess = np.array([[np.nan, 100.0], [1.0, 1.0], [5000.0, -70.0]])
    assert np.isnan(klt.track_translation(pyramid, pyramid, uv, guess, 2, 0, 2.0, 0.6, klt.WEIGHTS)).all()
    assert np.isnan(klt.track_translation(pyramid, pyramid, guess, uv, 2, 0, 2.0, 0.6, klt.WEIGHTS)).all()


def test_corners_keep_their_distance_and_the_mask() -> None:
    image = texture(6)
    mask = np.zeros((120, 160), bool)
    mask[20:100, 20:140] = True
    taken = np.array([[160.0, 120.0]])
    corners = detect_corners(klt.build_pyramid(image, 2)[1], mask, taken, 60, 20.0, 0.001)
    assert len(corners) > 30
    assert mask[(corners[:, 1] / 2).astype(int), (corners[:, 0] / 2).astype(int)].all()
    every = np.concatenate([taken, corners])
    distance = np.linalg.norm(every[:, None] - every[None], axis=-1) + 1e9 * np.eye(len(every))
    assert distance.min() > 18.0


def test_corners_are_not_on_edges() -> None:
    """A tilted bright patch with noise: its four ends are corners, no place along its sides is."""
    ends = np.array([[60, 70], [250, 84], [246, 170], [56, 156]])
    image = cv2.fillPoly(np.full((240, 320), 60, np.uint8), [ends], (220,), cv2.LINE_AA)
    noisy = np.clip(image + np.random.default_rng(8).normal(0, 3, image.shape), 0, 255).astype(np.uint8)
    pyramid = klt.build_pyramid(noisy, 2)
    everywhere = np.ones((120, 160), bool)
    corners = detect_corners(pyramid[1], everywhere, np.zeros((0, 2)), 100, 16.0, 0.01)
    to_end = np.linalg.norm(corners[:, None] - ends[None], axis=-1)
    assert (to_end.min(axis=0) < 7).all()
    outline = ends.astype(np.float32)
    to_side = np.abs([cv2.pointPolygonTest(outline, (float(u), float(v)), measureDist=True) for u, v in corners])
    assert not ((to_side < 6) & (to_end.min(axis=1) > 10)).any()


@pytest.mark.parametrize(("rotation", "predicted"), [((0.05, -0.12, 0.04), True), ((0.1, -0.5, 0.05), False)])
def test_rotation_of_a_whole_fisheye_image(rotation: tuple[float, float, float], predicted: bool) -> None:
    """A small one from a prediction; one of 29 degrees from none: it is searched for."""
    camera = KannalaBrandt(320, 300, 110.0, 110.0, 160.0, 150.0, (-0.004, 0.037, -0.035, 0.006))
    world = cv2.GaussianBlur(texture(7, 900, 1800), (0, 0), 20)
    world = cv2.normalize(world, None, 0, 255, cv2.NORM_MINMAX)
    truth = se3.so3_exp(np.array(rotation))

    def view(rotation: F64) -> U8:
        b = camera.bearing_grid() @ rotation
        u = (np.arctan2(b[..., 0], b[..., 2]) / np.pi + 1) * 899.5
        v = (np.arcsin(np.clip(np.nan_to_num(b[..., 1]), -1, 1)) / np.pi + 0.5) * 899
        return cv2.remap(world, np.nan_to_num(u).astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)

    before, after = klt.build_pyramid(view(np.eye(3)), 4), klt.build_pyramid(view(truth), 4)
    coarse = CoarseRotation(camera, 4)
    found = coarse.align(before, after, np.eye(3)) if predicted else coarse.search(before, after)
    assert np.degrees(np.linalg.norm(se3.so3_log(found @ truth.T))) < 0.3
