"""Rigid motions and rotations between point sets: exact, noisy, with outliers, refused."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.procrustes import rigid, rigid_batch, rigid_ransac, rotation_between, translation_ransac
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.types import F64


def cloud(seed: int, count: int = 60) -> tuple[F64, F64, F64]:
    rng = np.random.default_rng(seed)
    source = rng.uniform(-3, 3, (count, 3)) + np.array([0, 0, 6.0])
    motion = se3.exp(rng.normal(size=6) * 0.4)
    return source, se3.transform(motion, source), motion


@pytest.mark.parametrize("seed", range(6))
def test_rigid_is_exact_and_agrees_with_umeyama(seed: int) -> None:
    source, target, motion = cloud(seed)
    np.testing.assert_allclose(rigid(source, target), motion, atol=1e-10)
    np.testing.assert_allclose(se3.umeyama(source, target)[0], motion, atol=1e-10)
    np.testing.assert_allclose(rigid_batch(source[None], target[None])[0], motion, atol=1e-10)


@pytest.mark.parametrize("scale", [0.2, 1.0, 7.0])
def test_umeyama_recovers_the_scale(scale: float) -> None:
    source, target, motion = cloud(1)
    estimate, found = se3.umeyama(source, target * scale, with_scale=True)
    assert found == pytest.approx(scale, rel=1e-10)
    np.testing.assert_allclose(estimate[:3, :3], motion[:3, :3], atol=1e-10)


def test_rigid_never_reflects_even_for_mirrored_points() -> None:
    source, _, _ = cloud(2)
    assert np.linalg.det(rigid(source, source * np.array([1.0, 1.0, -1.0]))[:3, :3]) == pytest.approx(1.0)


def test_rigid_error_falls_with_the_number_of_points() -> None:
    errors = []
    for count in (20, 2000):
        source, target, motion = cloud(3, count)
        noise = np.random.default_rng(0).normal(size=target.shape) * 0.02
        errors.append(np.linalg.norm(se3.log(se3.inverse(rigid(source, target + noise)) @ motion)))
    assert errors[1] < 0.3 * errors[0] < 0.02


def test_weights_reduce_the_effect_of_noisy_points() -> None:
    source, target, motion = cloud(4)
    target = target.copy()
    target[:20] += 1.0
    weights = np.ones(len(source))
    weights[:20] = 1e-12
    np.testing.assert_allclose(rigid(source, target, weights), motion, atol=1e-6)


@pytest.mark.parametrize("outliers", [0.2, 0.6])
def test_rigid_ransac_finds_the_inliers(outliers: float) -> None:
    source, target, motion = cloud(5, 100)
    rng = np.random.default_rng(0)
    target = target + rng.normal(size=target.shape) * 0.002
    bad = rng.permutation(100)[: int(100 * outliers)]
    target[bad] += rng.uniform(1, 4, (len(bad), 3))
    found = rigid_ransac(source, target, 0.02, np.random.default_rng(1))
    assert not found.inliers[bad].any()
    assert found.inliers.sum() >= 0.95 * (100 - len(bad))
    chosen = rigid(source[found.inliers], target[found.inliers])
    assert np.linalg.norm(se3.log(se3.inverse(chosen) @ motion)) < 0.01


def test_translation_ransac_is_the_mean_of_its_inliers() -> None:
    source, target, motion = cloud(6)
    target = target.copy()
    target[:25] += 3.0
    rotated = source @ motion[:3, :3].T
    translation, found = translation_ransac(rotated, target, 0.05, np.random.default_rng(0))
    np.testing.assert_allclose(translation, motion[:3, 3], atol=1e-10)
    assert found.inliers.sum() == len(source) - 25


def test_rotation_between_bearings_is_exact() -> None:
    source, _, motion = cloud(7)
    bearings = source / np.linalg.norm(source, axis=1, keepdims=True)
    np.testing.assert_allclose(rotation_between(bearings, bearings @ motion[:3, :3].T), motion[:3, :3], atol=1e-12)


def test_collinear_and_too_few_are_refused() -> None:
    line = np.linspace(0, 1, 10)[:, None] * np.array([1.0, 2, 3])
    source, target, _ = cloud(8)
    for function in (rigid, lambda a, b: se3.umeyama(a, b)[0]):
        with pytest.raises(ValueError, match=r"collinear|points"):
            function(line, line)
        with pytest.raises(ValueError, match=r"too_few|three"):
            function(source[:2], target[:2])
    with pytest.raises(Degenerate, match="collinear"):
        rotation_between(np.repeat(source[:1], 5, 0), np.repeat(source[:1], 5, 0))
    assert np.isnan(rigid_batch(line[None, :3], line[None, :3])).all()
    with pytest.raises(Degenerate):
        rigid_ransac(line, line, 0.01, np.random.default_rng(0))


def test_all_outliers_are_refused() -> None:
    rng = np.random.default_rng(0)
    source, target = rng.uniform(-5, 5, (100, 3)), rng.uniform(-5, 5, (100, 3))
    with pytest.raises(Degenerate, match="no_consensus"):
        rigid_ransac(source, target, 0.05, np.random.default_rng(0))
    with pytest.raises(Degenerate, match="no_consensus"):
        translation_ransac(source, target, 0.05, np.random.default_rng(0))
    with pytest.raises(Degenerate, match="too_few_matches"):
        translation_ransac(source[:3], target[:3], 0.05, np.random.default_rng(0))
