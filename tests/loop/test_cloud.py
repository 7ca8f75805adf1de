"""What is matched to what: corners and points of keyframes, and which rows are one physical thing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereo_sfm.config import LoopConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop.cloud import gather, match_guided
from stereo_sfm.loop.place_view import place_view_of
from stereo_sfm.loop.verification import verify
from stereo_sfm.types import Corners, Keyframe
from tests.loop.store_walk import StoreWalk, make_walk

SIGMA = 0.5  # px


@pytest.fixture(scope="module")
def walk() -> StoreWalk:
    return make_walk([0], seed=4)


def test_corners_come_first_and_are_no_points(walk: StoreWalk) -> None:
    keyframe = walk.keyframes[5]
    view, n = place_view_of(keyframe, walk.rig, SIGMA), len(keyframe.corners)
    assert view.corner.sum() == n == 300
    assert (view.ids[:n] == -1).all() and np.array_equal(view.ids[n:], keyframe.point_ids)
    assert view.corner[:n].all() and not view.corner[n:].any()
    assert np.array_equal(keyframe.corners.descriptors, view.descriptors[:n])


def test_a_keyframe_without_corners_is_not_recognised(walk: StoreWalk) -> None:
    keyframe = dataclasses.replace(walk.keyframes[5], corners=Corners.none())
    view, cloud = place_view_of(keyframe, walk.rig, SIGMA), gather(walk.keyframes[5], [], walk.rig, SIGMA)
    assert not view.corner.any() and np.array_equal(view.ids, keyframe.point_ids)
    verdict = verify(view, cloud, walk.rig, LoopConfig(), np.random.default_rng(0))
    assert verdict.reason == "too_few_matches"


def test_points_without_a_descriptor_are_left_out(walk: StoreWalk) -> None:
    keyframe = walk.keyframes[5]
    some = keyframe.descriptors.copy()
    some[::2] = 0
    view = place_view_of(dataclasses.replace(keyframe, descriptors=some), walk.rig, SIGMA)
    assert np.array_equal(view.ids[300:], keyframe.point_ids[1::2])


def test_corners_of_neighbours_at_one_place_share_an_id(walk: StoreWalk) -> None:
    cloud = gather(walk.keyframes[5], [walk.keyframes[k] for k in (6, 4, 7)], walk.rig, SIGMA)
    views = [cloud.ids[cloud.corner & (cloud.view == k)] for k in range(4)]
    assert all(len(np.unique(ids)) == len(ids) == 300 for ids in views)
    for k, ids in enumerate(views[1:], 1):
        shared, at_0, at_k = np.intersect1d(views[0], ids, return_indices=True)
        assert len(shared) > 80
        points_0, points_k = (cloud.points[cloud.corner & (cloud.view == n)] for n in (0, k))
        apart = np.linalg.norm(points_0[at_0] - points_k[at_k], axis=1)
        assert np.median(apart) < 0.15  # stereo depth is that uncertain
    assert (cloud.ids[~cloud.corner] >= 0).all() and (cloud.ids[cloud.corner] < 0).all()


def test_two_corners_of_one_keyframe_never_share_an_id(walk: StoreWalk) -> None:
    """Each keyframe shows the same corner twice, as detectors of several scales do."""

    def doubled(k: int) -> Keyframe:
        c = walk.keyframes[k].corners
        twice = (np.repeat(column, 2, axis=0) for column in (c.uv_left, c.uv_right, c.points_cam, c.descriptors))
        return dataclasses.replace(walk.keyframes[k], corners=Corners(*twice))

    cloud = gather(doubled(5), [doubled(k) for k in (6, 4, 7, 3)], walk.rig, SIGMA)
    for k in range(5):
        ids = cloud.ids[cloud.corner & (cloud.view == k)]
        assert len(np.unique(ids)) == len(ids) == 600


def test_only_like_is_paired_with_like(walk: StoreWalk) -> None:
    a, b = walk.keyframes[5], walk.keyframes[6]
    cloud, view = gather(a, [], walk.rig, SIGMA), place_view_of(b, walk.rig, SIGMA)
    b_T_a = se3.inverse(walk.world_T_kf[6]) @ walk.world_T_kf[5]
    rows_b, rows_a = match_guided(b_T_a, view, cloud, walk.rig, 60, 4.0)
    assert np.array_equal(view.corner[rows_b], cloud.corner[rows_a])
    assert len(np.unique(rows_b)) == len(rows_b) and len(np.unique(rows_a)) == len(rows_a)
    points = ~view.corner[rows_b]
    assert points.sum() > 100 and (~points).sum() > 80
    assert np.mean(view.ids[rows_b[points]] == cloud.ids[rows_a[points]]) > 0.95
