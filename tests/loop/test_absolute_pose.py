"""The RANSAC of a relative pose, and the refinement over both cameras and both directions."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.loop import absolute_pose as ap
from stereo_sfm.types import F64
from tests.synthetic import fisheye_rig, pinhole_rig, see


def scene(rig: Rig, count: int, outliers: float, rng: np.random.Generator) -> tuple[F64, ap.Matches, np.ndarray]:
    """True pose, matches, and the mask of outliers."""
    b_T_a = se3.exp(np.array([0.3, 0.05, -0.4, 0.02, 0.25, 0.03]))
    points_a = rng.uniform([-2, -1, 2], [2, 1, 6], (count, 3))
    points_b = se3.transform(b_T_a, points_a)
    left_a, right_a = (uv + rng.normal(0, 0.5, uv.shape) for uv in see(rig, np.eye(4), points_a)[1:])
    left_b, right_b = (uv + rng.normal(0, 0.5, uv.shape) for uv in see(rig, se3.inverse(b_T_a), points_a)[1:])
    sigma_a, sigma_b = rig.range_sigmas(points_a, 0.5), rig.range_sigmas(points_b, 0.5)
    noisy_a = points_a * (1 + rng.normal(size=count) * sigma_a / np.linalg.norm(points_a, axis=1))[:, None]
    noisy_b = points_b * (1 + rng.normal(size=count) * sigma_b / np.linalg.norm(points_b, axis=1))[:, None]
    wrong = rng.random(count) < outliers
    rows = np.flatnonzero(wrong)
    for column in (left_b, right_b, noisy_b, sigma_b):
        column[rows] = column[np.roll(rows, 1)]
    visible = np.isfinite(left_b[:, 0])
    columns = (noisy_a, sigma_a, left_b, right_b, noisy_b, sigma_b, left_a, right_a)
    return b_T_a, ap.Matches(*(np.ascontiguousarray(c[visible]) for c in columns)), wrong[visible]


@pytest.mark.parametrize("rig", [pinhole_rig(), fisheye_rig()], ids=["pinhole", "fisheye"])
def test_pose_among_sixty_percent_outliers(rig: Rig) -> None:
    errors = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        b_T_a, matches, wrong = scene(rig, 200, 0.6, rng)
        start = ap.ransac_pose(matches, rig, rng, 1.0)
        assert start is not None
        pose = ap.refine_pose(start, matches, rig, 1.0)
        assert (pose.inlier & ~wrong).sum() > 0.8 * (~wrong).sum()
        assert (pose.inlier & wrong).sum() < 0.05 * wrong.sum() + 1
        errors.append(se3.log(pose.b_T_a @ se3.inverse(b_T_a)))
    assert np.sqrt((np.array(errors)[:, :3] ** 2).sum(1).mean()) < (0.01 if rig.left.model == "pinhole" else 0.03)
    assert np.rad2deg(np.abs(np.array(errors)[:, 3:])).max() < 0.7


def test_pose_of_a_camera_without_depth() -> None:
    rig, rng = fisheye_rig(), np.random.default_rng(4)
    b_T_a, matches, _ = scene(rig, 200, 0.5, rng)
    start = ap.ransac_pose(matches._replace(points_b=np.full_like(matches.points_b, np.nan)), rig, rng, 1.0)
    assert start is not None and np.linalg.norm((start @ se3.inverse(b_T_a))[:3, 3]) < 0.1


def test_no_pose_from_equal_points() -> None:
    rig = fisheye_rig()
    _, matches, _ = scene(rig, 1, 0.0, np.random.default_rng(0))
    assert ap.ransac_pose(ap.joined([matches] * 8), rig, np.random.default_rng(0), 1.0) is None


def test_information_predicts_the_scatter() -> None:
    """Within a factor of two in sigmas: noisy depth also biases a pose from fixed points (see refine_with_points)."""
    rig = pinhole_rig()
    normalised = []
    for seed in range(40):
        b_T_a, matches, _ = scene(rig, 150, 0.0, np.random.default_rng(100 + seed))
        pose = ap.refine_pose(b_T_a, matches, rig, 0.5)
        xi = se3.log(pose.b_T_a @ se3.inverse(b_T_a))
        normalised.append(xi @ pose.information @ xi)
    assert 3.0 < np.mean(normalised) < 24.0  # six degrees of freedom


def test_no_pose_from_three_matches() -> None:
    rig = fisheye_rig()
    _, matches, _ = scene(rig, 3, 0.0, np.random.default_rng(0))
    assert ap.ransac_pose(matches, rig, np.random.default_rng(0), 1.0) is None


def test_same_seed_same_bits() -> None:
    rig = fisheye_rig()
    _, matches, _ = scene(rig, 200, 0.5, np.random.default_rng(3))
    poses = [ap.ransac_pose(matches, rig, np.random.default_rng(9), 1.0) for _ in range(2)]
    assert poses[0] is not None and poses[1] is not None
    assert poses[0].tobytes() == poses[1].tobytes()
