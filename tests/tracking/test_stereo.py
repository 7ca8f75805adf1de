"""Stereo matches of corners on planes whose disparity is known, in every camera model and brightness."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.stereo import StereoMatch, StereoMatcher
from stereo_sfm.types import F32, F64, U8
from tests.synthetic import fisheye_rig, pinhole_rig


def texture() -> F32:
    """(900, 900) noise of many scales."""
    noise = np.random.default_rng(3).normal(size=(900, 900)).astype(np.float32)
    smooth = sum(sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (2.0, 6.0, 20.0))
    assert isinstance(smooth, np.ndarray)
    return np.clip(120 + 35 * smooth / smooth.std(), 0, 255).astype(np.float32)


def see_plane(rig: Rig, depth: float, pattern: F32, gain: float, offset: float) -> tuple[U8, U8]:
    """Both cameras' images of a plane `depth` metres ahead of the left one, the right image brighter or darker."""
    images: list[U8] = []
    for camera, left_T_cam, brightness in (
        (rig.left, np.eye(4), (1.0, 0.0)),
        (rig.right, rig.left_T_right, (gain, offset)),
    ):
        assert camera is not None
        ray = camera.bearing_grid() @ left_T_cam[:3, :3].T
        with np.errstate(all="ignore"):
            along = (depth - left_T_cam[2, 3]) / ray[..., 2]
            at = left_T_cam[:3, 3] + along[..., None] * ray
        ahead = np.isfinite(at).all(-1) & (ray[..., 2] > 0.1)
        metre = 220.0 / depth  # pixels of the pattern
        xy = np.where(ahead[..., None], at[..., :2] * metre + 450, -1).astype(np.float32)
        seen = cv2.remap(pattern, xy[..., 0], xy[..., 1], cv2.INTER_CUBIC, borderValue=0)
        images.append(np.clip(brightness[0] * seen + brightness[1], 0, 255).astype(np.uint8))
    return images[0], images[1]


def matches(rig: Rig, images: tuple[U8, U8], coarse: bool) -> tuple[F64, StereoMatch]:
    """Corners around the image centre and their matches."""
    matcher = StereoMatcher(TrackerConfig(), rig)
    left, right = (klt.build_pyramid(image, 4) for image in images)
    width, height = rig.left.size
    u, v = np.meshgrid(np.arange(0.3 * width, 0.7 * width, 11.3), np.arange(0.3 * height, 0.7 * height, 11.7))
    uv = np.stack([u.ravel(), v.ravel()], 1)
    return uv, (matcher.match_coarse if coarse else matcher.match)(left, right, uv)


@pytest.mark.parametrize("rig", [pinhole_rig(), fisheye_rig()], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.7, 25.0)])
@pytest.mark.parametrize(("coarse", "most_px"), [(False, 0.1), (True, 0.6)])
@pytest.mark.parametrize("baselines", [8.0, 30.0])
def test_points_of_a_plane_are_found(
    rig: Rig, gain: float, offset: float, coarse: bool, most_px: float, baselines: float
) -> None:
    depth = baselines * rig.baseline
    uv, match = matches(rig, see_plane(rig, depth, texture(), gain, offset), coarse)
    assert match.good.mean() > 0.8
    bearing = rig.left.unproject(uv)
    truth = rig.project_right(bearing / bearing[:, 2:] * depth)
    error = np.linalg.norm(match.uv_right - truth, axis=1)[match.good]
    assert np.median(error) < most_px
    assert np.percentile(error, 95) < 3 * most_px
    along = bearing[match.good, 2] / match.rho[match.good]
    assert abs(np.median(along) / depth - 1) < 0.01


@pytest.mark.parametrize("rig", [pinhole_rig(), fisheye_rig()], ids=["pinhole", "fisheye"])
def test_most_of_a_repetitive_pattern_is_rejected(rig: Rig) -> None:
    stripes = np.tile(120 + 60 * np.sin(2 * np.pi * np.arange(900) / 9.0), (900, 1)).astype(np.float32)
    noise = np.random.default_rng(0).normal(0, 2.0, stripes.shape).astype(np.float32)
    _, match = matches(rig, see_plane(rig, 12 * rig.baseline, stripes + noise, 1.0, 0.0), coarse=False)
    assert match.good.mean() < 0.2


def test_two_different_images_have_no_matches() -> None:
    rig = pinhole_rig()
    left, _ = see_plane(rig, 1.0, texture(), 1.0, 0.0)
    _, right = see_plane(rig, 1.0, np.ascontiguousarray(texture()[::-1, ::-1]), 1.0, 0.0)
    for coarse in (False, True):
        _, match = matches(rig, (left, right), coarse)
        assert match.good.mean() < 0.1
