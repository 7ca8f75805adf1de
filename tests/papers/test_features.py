"""Keypoints, descriptors and matching on a textured image that moves by a known amount."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_sfm.config import FeaturesConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.papers.extraction import TABLE, Extractor, circle_mask, feature_kind
from stereo_sfm.papers.matching import epipolar_inliers, match_features
from stereo_sfm.types import F64, U8

SHIFT = np.array([7.0, -3.0])


def texture(seed: int = 0, size: tuple[int, int] = (320, 240)) -> U8:
    rng = np.random.default_rng(seed)
    image = np.zeros((size[1], size[0]), np.float32)
    for scale in (4, 8, 16):
        coarse = rng.normal(size=(size[1] // scale + 2, size[0] // scale + 2)).astype(np.float32)
        image += cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC) * scale
    image = (image - image.min()) / (image.max() - image.min())
    return (255 * image).astype(np.uint8)


def moved(image: U8) -> U8:
    matrix = np.array([[1, 0, SHIFT[0]], [0, 1, SHIFT[1]]])
    return np.asarray(cv2.warpAffine(image, matrix, image.shape[::-1], borderMode=cv2.BORDER_REFLECT), np.uint8)


@pytest.mark.parametrize("kind", list(TABLE))
def test_matches_follow_the_image(kind: str) -> None:
    image = texture()
    extractor = Extractor(FeaturesConfig(kind=kind))
    first, second = extractor.extract(image), extractor.extract(moved(image))
    assert len(first) > 50 and first.descriptors.shape[1] == TABLE[kind].width
    rows = match_features(first, second, TABLE[kind].norm, 0.8)
    assert len(rows) > 30
    error = np.linalg.norm(second.uv[rows[:, 1]] - first.uv[rows[:, 0]] - SHIFT, axis=1)
    assert np.median(error) < (1.2 if kind == "orb" else 0.6)  # ORB rounds to pixels of its coarse levels
    assert (error < 3).mean() > 0.9
    assert len(np.unique(rows[:, 1])) == len(rows)  # one match per target
    assert (np.diff(rows[:, 0]) > 0).all()


@pytest.mark.parametrize("kind", list(TABLE))
def test_an_empty_image_has_no_features_and_no_matches(kind: str) -> None:
    extractor = Extractor(FeaturesConfig(kind=kind))
    blank = extractor.extract(np.full((240, 320), 90, np.uint8))
    assert len(blank) == 0 and blank.descriptors.shape == (0, TABLE[kind].width)
    assert match_features(blank, extractor.extract(texture()), TABLE[kind].norm, 0.8).shape == (0, 2)


def test_count_limits_the_keypoints() -> None:
    for kind, most in (("orb", 100), ("sift", 60), ("akaze", 60)):
        assert 0 < len(Extractor(FeaturesConfig(kind=kind, count=most)).extract(texture())) <= most + 5


def test_the_mask_keeps_features_near_its_points() -> None:
    image = texture()
    centres = np.array([[100.0, 100.0], [200.0, 120.0]])
    mask = circle_mask(image.shape, centres, 25.0)
    found = Extractor(FeaturesConfig(kind="sift")).extract(image, mask)
    nearest = np.linalg.norm(found.uv[:, None] - centres[None], axis=2).min(axis=1)
    assert len(found) > 3
    assert nearest.max() < 27


def test_unknown_features_are_one_clear_line() -> None:
    with pytest.raises(StereoSfmError, match="sift"):
        feature_kind("surf")


def bearings_with_outliers(wide: bool) -> tuple[F64, F64, int]:
    rng = np.random.default_rng(1)
    count, bad = 150, 40
    points = rng.normal(size=(count, 3)) * 3 if wide else rng.uniform([-3, -2, 2], [3, 2, 8], (count, 3))
    if wide:
        points /= np.linalg.norm(points, axis=1, keepdims=True) / rng.uniform(2, 6, (count, 1))
    other = se3.transform(se3.exp(np.array([0.1, 0.02, -0.3, 0.02, -0.03, 0.01])), points)
    other[:bad] = other[rng.permutation(bad)]
    first, second = (p / np.linalg.norm(p, axis=1, keepdims=True) for p in (points, other))
    return first, second, bad


@pytest.mark.parametrize("wide", [False, True])
def test_epipolar_ransac_rejects_outliers_in_pinhole_and_fisheye(wide: bool) -> None:
    first, second, bad = bearings_with_outliers(wide)
    inliers = epipolar_inliers(first, second, 1 / 400.0, np.random.default_rng(0))
    assert inliers[bad:].mean() > 0.97
    assert inliers[:bad].mean() < 0.25
    again = epipolar_inliers(first, second, 1 / 400.0, np.random.default_rng(0))
    assert (inliers == again).all()


def test_too_few_matches_have_no_epipolar_inliers() -> None:
    first, second, _ = bearings_with_outliers(False)
    assert not epipolar_inliers(first[:7], second[:7], 0.01, np.random.default_rng(0)).any()
