"""Monocular start: its 90 % rule and its guards, the homography behind them, and the local points of the tracker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.homography import PLANAR_RATIO, homographies, homography_ransac, planarity, transfer_errors
from stereo_sfm.geometry.motion_only import refine_pose
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.geometry.two_view import essential_from_motion
from stereo_sfm.papers.extraction import Features
from stereo_sfm.papers.feature_view import FeatureView
from stereo_sfm.papers.local_points import LocalPoints
from stereo_sfm.papers.monocular_start import TwoViewStart, good_points, start_from
from stereo_sfm.papers.point_ids import PointIds
from stereo_sfm.tracking.flow.map_points import rows_of
from stereo_sfm.types import F64, MapUpdate
from tests.papers.synthetic_views import PIXEL, unit

CONFIG = OdometryConfig(method="pnp")
MOTION = se3.exp(np.array([-0.5, 0.05, 0.1, 0.01, 0.04, -0.02]))  # second_T_first


def views(motion: F64 = MOTION, planar: bool = False, noise_px: float = 0.3, count: int = 200) -> tuple[F64, F64, F64]:
    """Bearings in both cameras and the points in the first."""
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-3, 3, count), rng.uniform(-2, 2, count), rng.uniform(3, 9, count)], 1)
    if planar:
        points[:, 2] = 5 + 0.2 * points[:, 0] - 0.1 * points[:, 1]
    moved = se3.transform(motion, points)
    noise = [rng.normal(size=(count, 3)) * noise_px * PIXEL for _ in range(2)]
    return unit(unit(points) + noise[0]), unit(unit(moved) + noise[1]), points


def start(b0: F64, b1: F64, config: OdometryConfig = CONFIG) -> TwoViewStart:
    return start_from(b0, b1, PIXEL, config, np.random.default_rng(0))


def test_the_start_is_the_true_motion_up_to_scale() -> None:
    b0, b1, points = views()
    found = start(b0, b1)
    truth = se3.inverse(MOTION)
    step = found.first_T_second[:3, 3]
    assert np.degrees(np.linalg.norm(se3.so3_log(found.first_T_second[:3, :3].T @ truth[:3, :3]))) < 0.1
    assert step @ truth[:3, 3] / np.linalg.norm(step) / np.linalg.norm(truth[:3, 3]) > 0.9995
    seen = np.isfinite(found.points[:, 2])
    assert seen.mean() > 0.9
    assert np.median(np.linalg.norm(found.points[seen], axis=1)) == pytest.approx(1.0)
    ratio = np.linalg.norm(found.points[seen], axis=1) / np.linalg.norm(points[seen], axis=1)
    assert np.std(ratio) / np.mean(ratio) < 0.05  # one scale for all


@pytest.mark.parametrize(
    ("case", "reason"),
    [
        ("few", "too_few_matches"),
        ("turn", "pure_rotation"),
        ("plane", "planar_or_low_parallax|low_parallax"),
        ("small_step", "pure_rotation|low_parallax"),
        ("outliers", "below_share"),
        ("random", "no_consensus|below_share"),
    ],
)
def test_starts_that_are_refused(case: str, reason: str) -> None:
    b0, b1, points = views()
    rng = np.random.default_rng(1)
    if case == "few":
        b0, b1 = b0[:30], b1[:30]
    if case == "turn":
        b1 = unit(points @ MOTION[:3, :3].T)
    if case == "plane":
        b0, b1, _ = views(planar=True)
    if case == "small_step":
        slow = MOTION.copy()
        slow[:3, 3] *= 0.05
        b0, b1, _ = views(slow)
    if case == "outliers":
        b1[:40] = b1[rng.permutation(40)]
    if case == "random":
        b1 = b1[rng.permutation(len(b1))]
    with pytest.raises(Degenerate, match=reason):
        start(b0, b1)


def test_the_share_is_configuration() -> None:
    b0, b1, _ = views()
    b1[:40] = b1[np.random.default_rng(1).permutation(40)]
    assert np.isfinite(start(b0, b1, replace(CONFIG, init_share=0.7)).first_T_second).all()


def test_homographies_are_exact_on_planes_and_beyond_ninety_degrees() -> None:
    rng = np.random.default_rng(3)
    b0, b1, _ = views(planar=True, noise_px=0.0)
    model = homographies(b0[None, :4], b1[None, :4])
    assert transfer_errors(model, b0, b1).max() < 1e-6
    around = unit(rng.normal(size=(60, 3)))
    turned = around @ MOTION[:3, :3].T  # a pure rotation is a homography in all directions
    assert transfer_errors(homographies(around[None, :4], turned[None, :4]), around, turned).max() < 1e-6
    found = homography_ransac(b0, b1, PIXEL, np.random.default_rng(0))
    assert found.inliers.all()


def test_planarity_separates_a_plane_from_a_room() -> None:
    essential = essential_from_motion(MOTION[:3, :3], MOTION[:3, 3])
    values = []
    for planar in (False, True):
        b0, b1, _ = views(planar=planar)
        values.append(planarity(essential, b0, b1, PIXEL, np.random.default_rng(0)))
    assert values[0] < PLANAR_RATIO - 0.1 < PLANAR_RATIO < values[1]


def test_good_points_are_true_and_wrong_matches_are_not_points() -> None:
    b0, b1, points = views(noise_px=0.0)
    found = good_points(b0, b1, se3.inverse(MOTION), 2 * PIXEL, np.radians(0.5))
    np.testing.assert_allclose(found, points, atol=1e-6)
    wrong = good_points(b0, np.roll(b1, 1, axis=0), se3.inverse(MOTION), 2 * PIXEL, np.radians(0.5))
    assert np.isnan(wrong[:, 0]).mean() > 0.9


def test_motion_only_adjustment_is_exact_and_refuses_what_it_cannot() -> None:
    _, _, points = views()
    bearings = unit(se3.transform(MOTION, points))
    near = se3.exp(np.array([0.1, -0.05, 0.05, 0.03, -0.02, 0.01])) @ MOTION
    refined = refine_pose(points, bearings, near, PIXEL, iterations=20)
    np.testing.assert_allclose(refined.cam_T_ref, MOTION, atol=1e-7)
    assert (np.linalg.eigvalsh(refined.covariance) > 0).all()
    with pytest.raises(Degenerate, match="too_few_points"):
        refine_pose(points[:2], bearings[:2], near, PIXEL)
    with pytest.raises(Degenerate, match="ill_conditioned"):
        refine_pose(np.repeat(points[:1], 9, 0), np.repeat(bearings[:1], 9, 0), near, PIXEL)


def some_view(ids: list[int], points: F64) -> FeatureView:
    n = len(ids)
    features = Features(np.zeros((n, 2)), np.full((n, 32), 7, np.uint8))
    return FeatureView(
        0, np.zeros((4, 4), np.uint8), features, unit(points), np.full((n, 2), np.nan), points, np.ones(n),
        np.array(ids, np.int64), np.zeros(n, np.int32),
    )  # fmt: skip


def test_local_points_follow_the_map() -> None:
    local = LocalPoints(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))
    points = np.array([[0.0, 0, 2], [1, 0, 3], [0, 1, 4], [1, 1, 5]])
    local.add(some_view([4, 5, 6, 7], points), np.eye(4))
    ids = PointIds()
    ids.fuse(np.array([[7, 4]]))
    map_T_odom = se3.exp(np.array([1.0, 0, 0, 0, 0, 0.2]))
    moved = se3.transform(map_T_odom, points[:1] + 0.1)
    none = np.zeros(0, np.int64)
    update = MapUpdate(
        1, 0, none, np.zeros((0, 4, 4)), np.array([4]), moved, np.array([6]), np.array([[7, 4]]), map_T_odom
    )
    local.apply(update, ids)
    assert sorted(local.ids.tolist()) == [4, 5]  # 6 was culled, 7 is 4
    np.testing.assert_allclose(local.positions(np.array([4, 5])), [points[0] + 0.1, points[1]], atol=1e-12)
    assert np.isnan(local.positions(np.array([99]))).all()


def test_rows_of_ids() -> None:
    hit, rows = rows_of(np.array([7, 3, 5]), np.array([5, 4, 7]))
    assert hit.tolist() == [True, False, True] and rows.tolist() == [2, 0]
    assert not rows_of(np.zeros(0, np.int64), np.array([1]))[0].any()
