"""Two-view geometry on scenes with known truth: exact, noisy, with outliers, and inputs that must be rejected."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.epipolar_refine import refine_motion
from stereo_sfm.geometry.essential import RelativePose, decompose, eight_point, relative_pose
from stereo_sfm.geometry.five_point import five_point
from stereo_sfm.geometry.robust import Degenerate, needed_samples, ransac, sample_indices
from stereo_sfm.geometry.two_view import epipolar_residuals, essential_from_motion, parallax_angles, ray_depths
from stereo_sfm.types import F64

PIXEL = 1.0 / 400.0  # radians per pixel of a typical camera


def angle_deg(a: F64, b: F64) -> float:
    return float(np.degrees(np.linalg.norm(se3.so3_log(a.T @ b))))


def unit(v: F64) -> F64:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def scene(seed: int, count: int = 120, wide: bool = False, planar: bool = False) -> tuple[F64, F64, F64, F64]:
    """Bearings in two cameras, rotation and translation of p1 = R p0 + t. `wide`: points all around the camera."""
    rng = np.random.default_rng(seed)
    if wide:
        points = unit(rng.normal(size=(count, 3))) * rng.uniform(2, 8, (count, 1))
    else:
        points = np.stack([rng.uniform(-3, 3, count), rng.uniform(-2, 2, count), rng.uniform(3, 9, count)], 1)
    if planar:
        points[:, 2] = 5 + 0.3 * points[:, 0]
    rotation = se3.so3_exp(rng.normal(size=3) * 0.1)
    translation = unit(rng.normal(size=3)) * 0.7
    return unit(points), unit(points @ rotation.T + translation), rotation, translation


def noisy(bearings: F64, rng: np.random.Generator, sigma: float) -> F64:
    return unit(bearings + rng.normal(size=bearings.shape) * sigma)


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_five_point_finds_the_true_matrix_among_its_solutions(seed: int, wide: bool) -> None:
    b0, b1, rotation, translation = scene(seed, 5, wide)
    solutions = five_point(b0[None], b1[None])
    truth = essential_from_motion(rotation, translation)
    truth /= np.linalg.norm(truth)
    distance = np.minimum(np.abs(solutions - truth).max((1, 2)), np.abs(solutions + truth).max((1, 2)))
    assert 1 <= len(solutions) <= 10
    assert distance.min() < 1e-6
    assert epipolar_residuals(solutions, b0, b1).max() < 1e-8  # every solution satisfies its five points


def test_five_point_agrees_with_opencv_on_samples() -> None:
    b0, b1, _, _ = scene(11, 5)
    ours = five_point(b0[None], b1[None])
    theirs = cv2.findEssentialMat(b0[:, :2] / b0[:, 2:], b1[:, :2] / b1[:, 2:], np.eye(3), cv2.RANSAC, 0.999, 1e-3)[0]
    assert theirs is not None
    for matrix in theirs.reshape(-1, 3, 3):
        matrix = matrix / np.linalg.norm(matrix)
        gap = np.minimum(np.abs(ours - matrix).max((1, 2)), np.abs(ours + matrix).max((1, 2))).min()
        assert gap < 1e-5


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_eight_point_is_exact_on_exact_data(seed: int, wide: bool) -> None:
    b0, b1, rotation, translation = scene(seed, 30, wide)
    estimate = eight_point(b0, b1)
    truth = essential_from_motion(rotation, translation)
    truth /= np.linalg.norm(truth)
    assert min(np.abs(estimate - truth).max(), np.abs(estimate + truth).max()) < 1e-8


def test_eight_point_in_pixels_gives_the_fundamental_matrix() -> None:
    b0, b1, rotation, translation = scene(3, 40)
    k = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    u0, u1 = (b0 / b0[:, 2:]) @ k.T, (b1 / b1[:, 2:]) @ k.T
    essential = k.T @ eight_point(u0, u1) @ k
    truth = essential_from_motion(rotation, translation)
    essential, truth = essential / np.linalg.norm(essential), truth / np.linalg.norm(truth)
    assert min(np.abs(essential - truth).max(), np.abs(essential + truth).max()) < 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_decomposition_contains_the_motion(seed: int) -> None:
    _, _, rotation, translation = scene(seed, 5)
    rotations, translations = decompose(essential_from_motion(rotation, translation))
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-12)
    errors = np.abs(rotations - rotation).max((1, 2)) + np.abs(translations - unit(translation)).max(1)
    assert errors.min() < 1e-9


@pytest.mark.parametrize("method", ["five_point", "eight_point"])
@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_relative_pose_with_noise_and_outliers(seed: int, wide: bool, method: str) -> None:
    b0, b1, rotation, translation = scene(seed, 200, wide)
    rng = np.random.default_rng(100 + seed)
    b0, b1 = noisy(b0, rng, 0.3 * PIXEL), noisy(b1, rng, 0.3 * PIXEL)
    wrong = rng.permutation(200)[:50]
    b1[wrong] = b1[rng.permutation(wrong)]
    pose = relative_pose(b0, b1, 1.5 * PIXEL, np.random.default_rng(0), method=method, max_samples=1024)
    assert angle_deg(pose.rotation, rotation) < 0.15
    assert np.degrees(np.arccos(np.clip(pose.direction @ unit(translation), -1, 1))) < 1.5
    assert not pose.pure_rotation
    assert pose.inliers[np.setdiff1d(np.arange(200), wrong)].mean() > 0.95


def test_refinement_lowers_the_rotation_error_of_a_minimal_solution() -> None:
    before, after = [], []
    for seed in range(8):
        b0, b1, rotation, _ = scene(seed, 200)
        rng = np.random.default_rng(seed)
        b0, b1 = noisy(b0, rng, 0.4 * PIXEL), noisy(b1, rng, 0.4 * PIXEL)
        raw = relative_pose(b0, b1, 1.5 * PIXEL, np.random.default_rng(0), refine=False)
        fine = relative_pose(b0, b1, 1.5 * PIXEL, np.random.default_rng(0), refine=True)
        before.append(angle_deg(raw.rotation, rotation))
        after.append(angle_deg(fine.rotation, rotation))
    assert np.median(after) < 0.6 * np.median(before)


def test_refine_motion_reaches_the_truth_from_a_perturbed_start() -> None:
    b0, b1, rotation, translation = scene(1, 100)
    start = se3.so3_exp(np.array([0.01, -0.02, 0.01])) @ rotation
    refined, direction = refine_motion(start, unit(translation + 0.05), b0, b1, 1.0, iterations=20)
    assert angle_deg(refined, rotation) < 1e-6
    assert direction @ unit(translation) > 1 - 1e-10


def test_planar_scene_is_exact_with_five_points_and_refused_by_eight() -> None:
    b0, b1, rotation, _ = scene(5, 80, planar=True)
    pose = relative_pose(b0, b1, 0.5 * PIXEL, np.random.default_rng(0))
    assert angle_deg(pose.rotation, rotation) < 1e-3
    with pytest.raises(Degenerate, match="degenerate_points"):
        eight_point(b0, b1)


def test_pure_rotation_is_recognised_and_its_rotation_right() -> None:
    b0, _, rotation, _ = scene(6, 100)
    b1 = noisy(b0 @ rotation.T, np.random.default_rng(0), 0.2 * PIXEL)
    pose = relative_pose(b0, b1, 1.5 * PIXEL, np.random.default_rng(0))
    assert pose.pure_rotation
    assert angle_deg(pose.rotation, rotation) < 0.05


@pytest.mark.parametrize("step", [0.0, 0.05, 0.1])
def test_a_small_step_is_distinguished_from_a_rotation(step: float) -> None:
    """Points at 3 to 9 m, 0.3 px of noise: 50 mm are 3 px of parallax, of which a rotation explains two thirds."""
    found: list[bool] = []
    turns: list[float] = []
    directions: list[float] = []
    for seed in range(6):
        b0, _, rotation, translation = scene(seed, 200)
        depth = np.random.default_rng(seed).uniform(3, 9, (200, 1))
        b1 = unit(b0 * depth @ rotation.T + step * unit(translation))
        rng = np.random.default_rng(seed)
        pose = relative_pose(noisy(b0, rng, 0.3 * PIXEL), noisy(b1, rng, 0.3 * PIXEL), 1.5 * PIXEL, rng)
        turns.append(angle_deg(pose.rotation, rotation))
        directions.append(float(pose.direction @ unit(translation)))
        found.append(not pose.pure_rotation)
    assert np.median(turns) < (0.3 if step > 0.05 else 0.2)
    assert np.mean(found) <= 0.2 if step == 0 else np.mean(found) >= 0.5
    assert step < 0.05 or np.median(directions) > np.cos(np.radians(25))


@pytest.mark.parametrize("points", ["few", "identical", "collinear", "pure_rotation"])
def test_eight_point_refuses_what_it_cannot_determine(points: str) -> None:
    b0, b1, rotation, _ = scene(7, 40)
    if points == "few":
        b0, b1 = b0[:7], b1[:7]
    if points == "identical":
        b0, b1 = np.repeat(b0[:1], 20, 0), np.repeat(b1[:1], 20, 0)
    if points == "collinear":
        line = np.linspace(0, 1, 20)[:, None] * np.array([1.0, 0.5, 1.0]) + np.array([0.0, 0, 4])
        b0, b1 = unit(line), unit(line @ rotation.T + np.array([0.3, 0, 0.1]))
    if points == "pure_rotation":
        b1 = b0 @ rotation.T
    with pytest.raises(Degenerate):
        eight_point(b0, b1)


def test_relative_pose_refuses_random_matches_and_too_few() -> None:
    rng = np.random.default_rng(0)
    b0, b1 = scene(8, 200)[0], scene(9, 200)[1][rng.permutation(200)]
    with pytest.raises(Degenerate, match="no_consensus"):
        relative_pose(b0, b1, PIXEL, np.random.default_rng(0))
    with pytest.raises(Degenerate, match="too_few_matches"):
        relative_pose(b0[:6], b1[:6], PIXEL, np.random.default_rng(0))


def pose_or_refusal(b0: F64, b1: F64, method: str) -> RelativePose | str:
    try:
        return relative_pose(b0, b1, PIXEL, np.random.default_rng(0), method=method)
    except Degenerate as refusal:
        return refusal.reason


@pytest.mark.parametrize("method", ["five_point", "eight_point"])
def test_identical_and_collinear_points_are_refused(method: str) -> None:
    b0, b1, rotation, _ = scene(10, 40)
    same = np.repeat(b0[:1], 40, 0), np.repeat(b1[:1], 40, 0)
    line = np.linspace(0, 1, 40)[:, None] * np.array([1.0, 0.5, 1.0]) + np.array([0.0, 0, 4])
    for pair in (same, (unit(line), unit(line @ rotation.T + np.array([0.3, 0, 0.1])))):
        assert pose_or_refusal(*pair, method) in ("collinear", "no_consensus")


def test_decompose_refuses_rank_one_and_nan() -> None:
    with pytest.raises(Degenerate, match="not_essential"):
        decompose(np.outer([1.0, 2, 3], [1.0, 0, 0]))
    with pytest.raises(Degenerate, match="not_essential"):
        decompose(np.full((3, 3), np.nan))


@pytest.mark.parametrize("wide", [False, True])
def test_ray_depths_are_the_distances_and_negative_behind(wide: bool) -> None:
    rng = np.random.default_rng(2)
    points = unit(rng.normal(size=(50, 3))) * 5 if wide else rng.uniform([-2, -2, 3], [2, 2, 8], (50, 3))
    motion = se3.exp(np.array([-0.1, 0.02, 0.01, 0.05, -0.02, 0.01]))
    moved = se3.transform(motion, points)
    depth0, depth1 = ray_depths(unit(points), unit(moved), motion[:3, :3], motion[:3, 3])
    np.testing.assert_allclose(depth0, np.linalg.norm(points, axis=1), atol=1e-7)
    np.testing.assert_allclose(depth1, np.linalg.norm(moved, axis=1), atol=1e-7)
    assert (ray_depths(unit(points), -unit(moved), motion[:3, :3], motion[:3, 3])[1] < 0).all()
    assert (parallax_angles(unit(points), unit(moved), motion[:3, :3]) > 0).all()


def test_sampling_is_distinct_and_repeatable() -> None:
    for count in (6, 1000):
        first = sample_indices(np.random.default_rng(5), 300, count, 5)
        assert (np.diff(np.sort(first, axis=1), axis=1) > 0).all()
        assert (first == sample_indices(np.random.default_rng(5), 300, count, 5)).all()
    assert needed_samples(0.5, 5, 0.99) == 146  # Hartley and Zisserman, table 4.3
    assert needed_samples(1.0, 5, 0.99) == 1
    assert needed_samples(0.0, 5, 0.99) > 10**8


def test_ransac_counts_nan_residuals_as_outliers() -> None:
    data = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 9.0, np.nan])
    found = ransac(
        7,
        1,
        lambda i: np.nan_to_num(data[i[:, 0]])[:, None],
        lambda m: np.abs(data[None] - m),
        0.1,
        np.random.default_rng(0),
        min_inliers=4,
    )
    assert found.inliers.tolist() == [True] * 5 + [False] * 2
