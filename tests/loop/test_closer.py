"""The loop closer on synthetic walks with exact truth: true loops are found, copies of an aisle are not loops."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereo_sfm.config import LoopConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop import vocabulary as voc
from stereo_sfm.loop.closer import LoopCloser
from stereo_sfm.types import LoopResult
from tests.loop.store_walk import StoreWalk, make_walk


@pytest.fixture(scope="module")
def vocabulary() -> voc.Vocabulary:
    return voc.train([k.descriptors for k in make_walk([0], seed=99).keyframes], depth=3)


def close(walk: StoreWalk, vocabulary: voc.Vocabulary, config: LoopConfig | None = None) -> list[LoopResult]:
    closer = LoopCloser(config or LoopConfig(), walk.rig, vocabulary)
    return [closer.step(k) for k in walk.keyframes]


def error_of(walk: StoreWalk, loop: LoopResult) -> float:
    truth = se3.inverse(walk.world_T_kf[loop.candidate_kf_id]) @ walk.world_T_kf[loop.kf_id]
    return float(np.linalg.norm((se3.inverse(truth) @ loop.candidate_T_kf)[:3, 3]))


@pytest.mark.parametrize("corners", [0, 300])
def test_a_walk_that_returns_is_closed_and_its_points_are_paired(vocabulary: voc.Vocabulary, corners: int) -> None:
    walk = make_walk([0, 1, 0], seed=3, max_corners=corners)
    results = close(walk, vocabulary)
    assert [r.kf_id for r in results] == [k.kf_id for k in walk.keyframes]  # exactly one answer each
    loops = [r for r in results if r.candidate_kf_id >= 0]
    second_visit = next(i for i, p in enumerate(walk.world_T_kf) if i > 90 and abs(p[0, 3]) < 0.1 and p[2, 2] > 0.9)
    assert any(r.kf_id >= second_visit for r in loops)
    for loop in loops:
        assert error_of(walk, loop) < 0.1
        assert loop.inliers >= LoopConfig().min_inliers
        right = [walk.physical[a] == walk.physical[b] for a, b in loop.matches.tolist()]
        assert np.mean(right) > 0.95
        assert np.linalg.eigvalsh(loop.information).min() > 0


def test_every_rejection_has_a_reason(vocabulary: voc.Vocabulary) -> None:
    results = close(make_walk([0, 1, 0], seed=3), vocabulary)
    for r in results:
        assert (r.reason == "") == (r.candidate_kf_id >= 0)
        assert all(reason and kf_id >= 0 for kf_id, _, reason in r.rejected)


@pytest.mark.parametrize("seed", range(2))
def test_identical_aisles_are_not_taken_for_each_other(vocabulary: voc.Vocabulary, seed: int) -> None:
    walk = make_walk([0, 1, 0], alike=1.0, seed=seed)
    loops = [r for r in close(walk, vocabulary) if r.candidate_kf_id >= 0]
    assert all(error_of(walk, loop) < 0.1 for loop in loops)
    assert any(walk.world_T_kf[r.kf_id][2, 2] > 0.9 and r.kf_id > 90 for r in loops)


def test_without_the_odometry_gate_identical_aisles_deceive(vocabulary: voc.Vocabulary) -> None:
    """The gate is what saves the test above: appearance and geometry alone accept the twin aisle."""
    walk = make_walk([0, 4], alike=1.0, seed=0)  # so far apart that neither is seen from the other
    blind = dataclasses.replace(LoopConfig(), gate_metres=100.0, gate_degrees=360.0)
    loops = [r for r in close(walk, vocabulary, blind) if r.candidate_kf_id >= 0]
    assert any(error_of(walk, loop) > 1.0 for loop in loops)


def test_of_two_places_that_look_alike_the_one_that_shows_more_is_taken(vocabulary: voc.Vocabulary) -> None:
    """Half of the products stand in both aisles, and odometry allows everything."""
    walk = make_walk([0, 4, 0], alike=0.5, seed=0)
    blind = dataclasses.replace(LoopConfig(), gate_metres=100.0, gate_degrees=360.0)
    again = next(i for i, p in enumerate(walk.world_T_kf) if i > 90 and abs(p[0, 3]) < 0.1 and p[2, 2] > 0.9)
    results = close(walk, vocabulary, blind)[again + 4 :]
    loops = [r for r in results if r.candidate_kf_id >= 0]
    assert loops and all(error_of(walk, r) < 0.1 for r in loops)
    assert any(reason == "better_elsewhere" for r in results for _, _, reason in r.rejected)


def test_pause_after_a_loop(vocabulary: voc.Vocabulary) -> None:
    results = close(make_walk([0, 0], seed=5), vocabulary, dataclasses.replace(LoopConfig(), pause=7))
    accepted = [r.kf_id for r in results if r.candidate_kf_id >= 0]
    assert len(accepted) >= 2
    assert min(np.diff(accepted)) > 7
    assert all(results[accepted[0] + i].reason == "paused" for i in range(1, 8))


def test_disabled_answers_every_keyframe_with_nothing(vocabulary: voc.Vocabulary) -> None:
    results = close(make_walk([0], seed=5), vocabulary, dataclasses.replace(LoopConfig(), enabled=False))
    assert {r.reason for r in results} == {"disabled"}


def test_same_walk_same_bits(vocabulary: voc.Vocabulary) -> None:
    def bits() -> list[bytes]:
        return [
            r.candidate_T_kf.tobytes() + r.matches.tobytes() + r.information.tobytes() + repr(r.rejected).encode()
            for r in close(make_walk([0, 0], seed=6), vocabulary)
        ]

    assert bits() == bits()


def test_vocabulary_grows_online(vocabulary: voc.Vocabulary) -> None:
    walk = make_walk([0, 0], seed=7)
    closer = LoopCloser(dataclasses.replace(LoopConfig(), grow_every=5), walk.rig, vocabulary)
    results = [closer.step(k) for k in walk.keyframes]
    assert len(closer.vocabulary) > len(vocabulary)
    assert any(r.candidate_kf_id >= 0 and error_of(walk, r) < 0.05 for r in results)


def test_a_view_seen_every_lap_is_remembered_a_few_times_and_still_closes(vocabulary: voc.Vocabulary) -> None:
    walk = make_walk([0, 1] * 7, seed=3)
    closer = LoopCloser(LoopConfig(), walk.rig, vocabulary)
    results, remembered = list[LoopResult](), list[int]()
    for keyframe in walk.keyframes:
        results.append(closer.step(keyframe))
        remembered.append(closer.remembered)
    lap = len(walk.keyframes) // 7
    assert remembered[lap] == lap + 1  # nothing is forgotten on the first lap
    assert remembered[-1] - remembered[-1 - lap] < 0.3 * lap  # hardly anything is added on the last
    assert any(r.candidate_kf_id >= 0 for r in results[-lap:])
    assert all(error_of(walk, r) < 0.1 for r in results if r.candidate_kf_id >= 0)


def test_tracking_that_began_anew_finds_the_place_it_just_left(vocabulary: voc.Vocabulary) -> None:
    """Dark for a moment: the new submap joins the old one at once, not when the robot comes round again."""
    walk = make_walk([0], seed=3)
    break_at = 20
    astray = se3.exp(np.array([5.0, 1, -8, 0.2, 1.0, 0]))
    keyframes = [
        k
        if i < break_at
        else dataclasses.replace(k, submap_id=1, odom_T_cam=astray @ k.odom_T_cam, point_ids=k.point_ids + 10**6)
        for i, k in enumerate(walk.keyframes[: break_at + 8])
    ]
    loops = [r for r in close(dataclasses.replace(walk, keyframes=keyframes), vocabulary) if r.candidate_kf_id >= 0]
    assert loops and loops[0].candidate_kf_id < break_at <= loops[0].kf_id < break_at + 5
    assert all(error_of(walk, loop) < 0.05 for loop in loops)


def test_tracking_that_began_anew_in_a_twin_aisle_does_not_join_the_first(vocabulary: voc.Vocabulary) -> None:
    """Dark between two identical aisles: the robot cannot have driven back so fast as the pictures say."""
    walk = make_walk([0, 1], alike=1.0, seed=0)
    turned = next(i for i, pose in enumerate(walk.world_T_kf) if pose[0, 3] > 1.0)
    rest = walk.keyframes[turned + 2 :]
    begin = se3.inverse(rest[0].odom_T_cam)
    keyframes = walk.keyframes[:turned] + [
        dataclasses.replace(k, submap_id=1, odom_T_cam=begin @ k.odom_T_cam, point_ids=k.point_ids + 10**6)
        for k in rest
    ]
    results = close(dataclasses.replace(walk, keyframes=keyframes), vocabulary)
    across = [r for r in results if r.candidate_kf_id >= 0 and r.candidate_kf_id < turned < r.kf_id]
    assert all(error_of(walk, r) < 0.1 for r in across)
    assert any(reason == "out_of_reach" for r in results for _, _, reason in r.rejected)
