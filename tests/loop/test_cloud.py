"""Clouds of keyframes: corners and points, and which rows show one physical point."""

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
from tests.loop.store_sequence import StoreSequence, make_sequence

SIGMA = 0.5  # px


@pytest.fixture(scope="module")
def sequence() -> StoreSequence:
    return make_sequence([0], seed=4)


def test_corners_come_first_and_are_not_map_points(sequence: StoreSequence) -> None:
    keyframe = sequence.keyframes[5]
    view, n = place_view_of(keyframe, sequence.rig, SIGMA), len(keyframe.corners)
    assert view.corner.sum() == n == 300
    assert (view.ids[:n] == -1).all() and np.array_equal(view.ids[n:], keyframe.point_ids)
    assert view.corner[:n].all() and not view.corner[n:].any()
    assert np.array_equal(keyframe.corners.descriptors, view.descriptors[:n])


def test_a_keyframe_without_corners_is_not_recognised(sequence: StoreSequence) -> None:
    keyframe = dataclasses.replace(sequence.keyframes[5], corners=Corners.none())
    view, cloud = place_view_of(keyframe, sequence.rig, SIGMA), gather(sequence.keyframes[5], [], sequence.rig, SIGMA)
    assert not view.corner.any() and np.array_equal(view.ids, keyframe.point_ids)
    verdict = verify(view, cloud, sequence.rig, LoopConfig(), np.random.default_rng(0))
    assert verdict.reason == "too_few_matches"


def test_points_without_a_descriptor_are_left_out(sequence: StoreSequence) -> None:
    keyframe = sequence.keyframes[5]
    some = keyframe.descriptors.copy()
    some[::2] = 0
    view = place_view_of(dataclasses.replace(keyframe, descriptors=some), sequence.rig, SIGMA)
    assert np.array_equal(view.ids[300:], keyframe.point_ids[1::2])


def test_the_same_corner_in_two_keyframes_has_one_id(sequence: StoreSequence) -> None:
    cloud = gather(sequence.keyframes[5], [sequence.keyframes[k] for k in (6, 4, 7)], sequence.rig, SIGMA)
    views = [cloud.ids[cloud.corner & (cloud.view == k)] for k in range(4)]
    assert all(len(np.unique(ids)) == len(ids) == 300 for ids in views)
    for k, ids in enumerate(views[1:], 1):
        shared, at_0, at_k = np.intersect1d(views[0], ids, return_indices=True)
        assert len(shared) > 80
        points_0, points_k = (cloud.points[cloud.corner & (cloud.view == n)] for n in (0, k))
        apart = np.linalg.norm(points_0[at_0] - points_k[at_k], axis=1)
        assert np.median(apart) < 0.15  # stereo depth is that uncertain
    assert (cloud.ids[~cloud.corner] >= 0).all() and (cloud.ids[cloud.corner] < 0).all()


def test_two_corners_of_one_keyframe_never_share_an_id(sequence: StoreSequence) -> None:
    """Each keyframe has the same corner twice, as detectors of several scales give it."""

    def doubled(k: int) -> Keyframe:
        c = sequence.keyframes[k].corners
        twice = (np.repeat(column, 2, axis=0) for column in (c.uv_left, c.uv_right, c.points_cam, c.descriptors))
        return dataclasses.replace(sequence.keyframes[k], corners=Corners(*twice))

    cloud = gather(doubled(5), [doubled(k) for k in (6, 4, 7, 3)], sequence.rig, SIGMA)
    for k in range(5):
        ids = cloud.ids[cloud.corner & (cloud.view == k)]
        assert len(np.unique(ids)) == len(ids) == 600


def test_corners_match_corners_and_points_match_points(sequence: StoreSequence) -> None:
    a, b = sequence.keyframes[5], sequence.keyframes[6]
    cloud, view = gather(a, [], sequence.rig, SIGMA), place_view_of(b, sequence.rig, SIGMA)
    b_T_a = se3.inverse(sequence.world_T_kf[6]) @ sequence.world_T_kf[5]
    rows_b, rows_a = match_guided(b_T_a, view, cloud, sequence.rig, 60, 4.0)
    assert np.array_equal(view.corner[rows_b], cloud.corner[rows_a])
    assert len(np.unique(rows_b)) == len(rows_b) and len(np.unique(rows_a)) == len(rows_a)
    points = ~view.corner[rows_b]
    assert points.sum() > 100 and (~points).sum() > 80
    assert np.mean(view.ids[rows_b[points]] == cloud.ids[rows_a[points]]) > 0.95
