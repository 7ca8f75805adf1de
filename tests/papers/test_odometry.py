"""Every motion estimator on matches with known motion: exact, noisy, with outliers, on fisheye bearings, rejected."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.config import OdometryConfig, estimator_names
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.papers.motion_estimator import FramePair, Motion, StepScale, estimator
from stereo_sfm.types import F64, Trajectory
from tests.papers.synthetic_views import PIXEL, frame_pair, unit

CAMERA = Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5)
MOTION = se3.exp(np.array([0.05, -0.02, -0.2, 0.01, 0.03, -0.01]))
BY_POINTS = [name for name in estimator_names() if name != "vp-r"]
ROBUST = ["em-r", "r-um", "eight-point", "pnp"]


def estimate(name: str, pair: FramePair, **options: object) -> Motion:
    config = replace(OdometryConfig(method=name), **options)
    return estimator(name).make(config, CAMERA)(pair, np.random.default_rng(0))


def errors(motion: Motion, truth: F64) -> tuple[float, float]:
    """Degrees and metres."""
    turn = np.linalg.norm(se3.so3_log(motion.rotation.T @ truth[:3, :3]))
    return float(np.degrees(turn)), float(np.linalg.norm(motion.translation - truth[:3, 3]))


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("name", BY_POINTS)
def test_exact_matches_give_the_exact_motion(name: str, wide: bool) -> None:
    degrees, metres = errors(estimate(name, frame_pair(MOTION, wide=wide)), MOTION)
    assert degrees < 1e-4
    assert metres < 1e-5


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("name", ROBUST)
def test_noise_and_a_third_of_outliers(name: str, wide: bool) -> None:
    motion = estimate(name, frame_pair(MOTION, 250, 0.4, 0.33, wide), max_samples=2048)
    degrees, metres = errors(motion, MOTION)
    assert degrees < (0.8 if name == "r-um" else 0.25)
    assert metres < (0.06 if name == "r-um" else 0.03)
    assert 0.5 < motion.inliers.mean() < 0.75


def test_without_outlier_removal_umeyama_is_far_off() -> None:
    pair = frame_pair(MOTION, 250, 0.4, 0.33)
    assert errors(estimate("um", pair), MOTION)[0] > 5 * errors(estimate("r-um", pair), MOTION)[0]


def test_rotation_of_em_r_is_better_than_that_of_points_with_stereo_depth() -> None:
    gain = []
    for seed in range(6):
        pair = frame_pair(MOTION, 200, 0.4, 0.1, seed=seed)
        gain.append(errors(estimate("em-r", pair), MOTION)[0] / errors(estimate("r-um", pair), MOTION)[0])
    assert np.median(gain) < 0.5


def test_weights_by_stereo_uncertainty_help_the_translation() -> None:
    plain, weighted = [], []
    for seed in range(8):
        pair = frame_pair(MOTION, 200, 0.4, seed=seed)
        plain.append(errors(estimate("em-r", pair, weighted=False), MOTION)[1])
        weighted.append(errors(estimate("em-r", pair, weighted=True), MOTION)[1])
    assert np.mean(weighted) < 0.7 * np.mean(plain)


@pytest.mark.parametrize("turn", [0.0, 0.05])
@pytest.mark.parametrize("name", ["em-r", "r-um", "pnp", "eight-point"])
def test_a_static_or_rotating_camera(name: str, turn: float) -> None:
    truth = se3.exp(np.array([0, 0, 0, 0, turn, 0.0]))
    degrees, metres = errors(estimate(name, frame_pair(truth, 200, 0.3)), truth)
    assert degrees < (1.0 if name == "r-um" else 0.3)
    assert metres < (0.06 if name == "r-um" else 0.015)


@pytest.mark.parametrize("name", BY_POINTS)
def test_too_few_matches_are_refused(name: str) -> None:
    with pytest.raises(Degenerate, match="too_few"):
        estimate(name, frame_pair(MOTION, 4))


@pytest.mark.parametrize("name", ROBUST)
def test_nothing_but_outliers_is_refused(name: str) -> None:
    first, second = frame_pair(MOTION, 200, seed=1), frame_pair(MOTION, 200, seed=2)
    mixed = replace(first, bearings_now=second.bearings_now, points_now=second.points_now)
    with pytest.raises(Degenerate):
        estimate(name, mixed)


@pytest.mark.parametrize("noise_px", [0.0, 0.3])
@pytest.mark.parametrize("name", BY_POINTS)
def test_wrong_matches_alone_are_refused_however_uncertain_the_depth_is(name: str, noise_px: float) -> None:
    """A narrow pair: a pixel of disparity is a metre at 6 m, and almost every motion is within three sigmas."""
    for seed in range(5):
        pair = frame_pair(MOTION, 80, noise_px, seed=seed, baseline=0.06)
        shuffled = np.random.default_rng(seed).permutation(80)
        mixed = replace(
            pair,
            bearings_now=pair.bearings_now[shuffled],
            points_now=pair.points_now[shuffled],
            sigmas_last=pair.sigmas_last * (1.0 / max(noise_px, 0.1)),
            sigmas_now=pair.sigmas_now[shuffled] * (1.0 / max(noise_px, 0.1)),
        )
        with pytest.raises(Degenerate, match="no_consensus"):
            estimate(name, mixed)


@pytest.mark.parametrize("name", ["em-r", "r-um", "um", "pnp", "eight-point"])
def test_the_same_image_again_gives_no_motion(name: str) -> None:
    """Without any noise no essential matrix is determined, and the rotation is."""
    pair = frame_pair(np.eye(4), 150)
    degrees, metres = errors(estimate(name, pair), np.eye(4))
    assert degrees < 1e-3 and metres < 1e-4


def test_an_exact_rotation_is_a_rotation() -> None:
    truth = se3.exp(np.array([0, 0, 0, 0, 0.05, 0.0]))
    for name in ("em-r", "eight-point"):
        degrees, metres = errors(estimate(name, frame_pair(truth, 150)), truth)
        assert degrees < 1e-3 and metres < 1e-4


@pytest.mark.parametrize("name", ["em-r", "r-um", "um", "pnp", "eight-point"])
def test_without_depth_there_is_no_metric_motion(name: str) -> None:
    with pytest.raises(Degenerate, match=r"too_few_points|no_scale"):
        estimate(name, frame_pair(MOTION, depth=False))


@pytest.mark.parametrize("noise_px", [0.0, 0.3])
@pytest.mark.parametrize("name", BY_POINTS)
def test_points_on_a_line_are_refused(name: str, noise_px: float) -> None:
    pair = frame_pair(MOTION, 60)
    rng = np.random.default_rng(3)
    line = np.linspace(0, 1, 60)[:, None] * np.array([1.0, 0.4, 0.5]) + np.array([-0.5, 0, 3])
    moved = se3.transform(MOTION, line)
    pair = replace(
        pair,
        points_last=line,
        points_now=moved,
        bearings_last=unit(unit(line) + rng.normal(size=line.shape) * noise_px * PIXEL),
        bearings_now=unit(unit(moved) + rng.normal(size=line.shape) * noise_px * PIXEL),
    )
    with pytest.raises(Degenerate, match=r"collinear|no_consensus|ill_conditioned"):
        estimate(name, pair)


def test_eight_point_without_metric_scale_gives_a_direction() -> None:
    motion = estimate("eight-point", frame_pair(MOTION, depth=False), scale="unit")
    assert not motion.metric
    assert motion.translation @ MOTION[:3, 3] / np.linalg.norm(MOTION[:3, 3]) == pytest.approx(1.0, abs=1e-6)
    stepped = StepScale(OdometryConfig(scale="unit"), None).metric(motion, 0, 1)
    assert np.linalg.norm(stepped.translation) == pytest.approx(1.0)


def test_ground_truth_scale_is_the_true_step() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = 0.0, 0.4, 1.0
    truth = Trajectory(np.array([0, 10, 20], np.int64), poses)
    scale = StepScale(OdometryConfig(scale="ground-truth"), truth)
    direction = Motion(np.eye(3), np.array([0, 0, -1.0]), np.ones(1, bool), metric=False)
    assert np.linalg.norm(scale.metric(direction, 0, 20).translation) == pytest.approx(1.0)
    assert np.linalg.norm(scale.metric(direction, 5, 10).translation) == pytest.approx(0.2)


def test_wrong_names_are_one_clear_line() -> None:
    with pytest.raises(StereoSfmError, match="em-r"):
        estimator("magic")
    with pytest.raises(StereoSfmError, match="unit"):
        StepScale(OdometryConfig(scale="ground-truth"), None)
    with pytest.raises(StereoSfmError, match="unknown"):
        StepScale(OdometryConfig(scale="metres"), None)


def test_a_file_in_the_folder_is_an_estimator() -> None:
    """One new file and no edit: the folder is the table."""
    import stereo_sfm.papers.odometry as folder

    own = Path(folder.__path__[0])
    assert set(estimator_names()) == {p.stem.replace("_", "-") for p in own.glob("[a-z]*.py")}
    for name in estimator_names():
        entry = estimator(name)
        assert entry.summary and callable(entry.make)
