"""The loop closer on synthetic sequences with exact truth: true loops are found, copies of an aisle are not loops."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from stereo_sfm.config import LoopConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop import vocabulary as voc
from stereo_sfm.loop.closer import GAP_WINDOW, Candidate, LoopCloser
from stereo_sfm.loop.verification import Verdict, rejection
from stereo_sfm.mapping.culling import PASSED
from stereo_sfm.types import F64, Corners, Keyframe, LoopResult
from tests.loop.store_sequence import StoreSequence, make_sequence


@pytest.fixture(scope="module")
def vocabulary() -> voc.Vocabulary:
    return voc.train([k.descriptors for k in make_sequence([0], seed=99).keyframes], depth=3)


def close(sequence: StoreSequence, vocabulary: voc.Vocabulary, config: LoopConfig | None = None) -> list[LoopResult]:
    closer = LoopCloser(config or LoopConfig(), sequence.rig, vocabulary)
    return [closer.step(k) for k in sequence.keyframes]


def error_of(sequence: StoreSequence, loop: LoopResult) -> float:
    truth = se3.inverse(sequence.world_T_kf[loop.candidate_kf_id]) @ sequence.world_T_kf[loop.kf_id]
    return float(np.linalg.norm((se3.inverse(truth) @ loop.candidate_T_kf)[:3, 3]))


def test_a_sequence_that_returns_has_a_loop_and_its_points_are_associated(vocabulary: voc.Vocabulary) -> None:
    sequence = make_sequence([0, 1, 0], seed=3)
    results = close(sequence, vocabulary)
    assert [r.kf_id for r in results] == [k.kf_id for k in sequence.keyframes]  # exactly one answer each
    loops = [r for r in results if r.candidate_kf_id >= 0]
    second_visit = next(i for i, p in enumerate(sequence.world_T_kf) if i > 90 and abs(p[0, 3]) < 0.1 and p[2, 2] > 0.9)
    assert any(r.kf_id >= second_visit for r in loops)
    for loop in loops:
        assert error_of(sequence, loop) < 0.1
        assert loop.inliers >= LoopConfig().min_inliers
        right = [sequence.physical[a] == sequence.physical[b] for a, b in loop.matches.tolist()]
        assert np.mean(right) > 0.95
        assert np.linalg.eigvalsh(loop.information).min() > 0


def test_every_rejection_has_a_reason(vocabulary: voc.Vocabulary) -> None:
    results = close(make_sequence([0, 1, 0], seed=3), vocabulary)
    for r in results:
        assert (r.reason == "") == (r.candidate_kf_id >= 0)
        assert all(reason and kf_id >= 0 for kf_id, _, reason in r.rejected)


@pytest.mark.parametrize("seed", range(2))
def test_identical_aisles_are_not_taken_for_each_other(vocabulary: voc.Vocabulary, seed: int) -> None:
    sequence = make_sequence([0, 1, 0], alike=1.0, seed=seed)
    loops = [r for r in close(sequence, vocabulary) if r.candidate_kf_id >= 0]
    assert all(error_of(sequence, loop) < 0.1 for loop in loops)
    assert any(sequence.world_T_kf[r.kf_id][2, 2] > 0.9 and r.kf_id > 90 for r in loops)


def test_without_the_odometry_gate_identical_aisles_deceive(vocabulary: voc.Vocabulary) -> None:
    """Without the gate of the test above, appearance and geometry accept the twin aisle."""
    sequence = make_sequence([0, 4], alike=1.0, seed=0)  # so far apart that neither is seen from the other
    blind = dataclasses.replace(LoopConfig(), gate_m=100.0, gate_deg=360.0)
    loops = [r for r in close(sequence, vocabulary, blind) if r.candidate_kf_id >= 0]
    assert any(error_of(sequence, loop) > 1.0 for loop in loops)


def test_of_two_similar_places_the_one_with_more_inliers_is_accepted(vocabulary: voc.Vocabulary) -> None:
    """Half of the products are in both aisles, and odometry allows everything."""
    sequence = make_sequence([0, 4, 0], alike=0.5, seed=0)
    blind = dataclasses.replace(LoopConfig(), gate_m=100.0, gate_deg=360.0)
    again = next(i for i, p in enumerate(sequence.world_T_kf) if i > 90 and abs(p[0, 3]) < 0.1 and p[2, 2] > 0.9)
    results = close(sequence, vocabulary, blind)[again + 4 :]
    loops = [r for r in results if r.candidate_kf_id >= 0]
    assert loops and all(error_of(sequence, r) < 0.1 for r in loops)
    assert any(reason == "better_elsewhere" for r in results for _, _, reason in r.rejected)


def scripted(sequence: StoreSequence, answers: dict[tuple[int, int], tuple[int, F64]]) -> Callable[..., Verdict]:
    """In place of `LoopCloser._verify`: (keyframe, candidate) -> inliers, and the error of the relative pose."""

    def answer(_: LoopCloser, keyframe: Keyframe, of: Candidate) -> Verdict:
        candidate = of.kf_id
        if (keyframe.kf_id, candidate) not in answers:
            return rejection("too_few_matches")
        inliers, error = answers[keyframe.kf_id, candidate]
        truth = se3.inverse(sequence.world_T_kf[candidate]) @ sequence.world_T_kf[keyframe.kf_id]
        nothing = np.zeros((0, 2), np.int64)
        return Verdict("", se3.inverse(truth @ error), np.eye(6), nothing, inliers, inliers / 300)

    return answer


def answers_of(
    sequence: StoreSequence, vocabulary: voc.Vocabulary, monkeypatch: pytest.MonkeyPatch,
    script: dict[tuple[int, int], int], wrong: set[int], keyframes: list[Keyframe] | None = None,
) -> list[LoopResult]:  # fmt: skip
    """Results if these candidates are verified with so many inliers; those in `wrong` are five metres off."""
    deviation = se3.exp(np.array([0, 0, 5.0, 0, 0, 0]))
    answers = {key: (inliers, deviation if key[1] in wrong else np.eye(4)) for key, inliers in script.items()}
    monkeypatch.setattr(LoopCloser, "_verify", scripted(sequence, answers))
    monkeypatch.setattr(
        LoopCloser,
        "_candidates",
        lambda self, keyframe, *_: ([Candidate(c, 0.5) for k, c in script if k == keyframe.kf_id], "no_candidate"),
    )
    return close(sequence if keyframes is None else dataclasses.replace(sequence, keyframes=keyframes), vocabulary)


def test_a_twin_contradicted_by_odometry_does_not_make_the_true_place_ambiguous(
    vocabulary: voc.Vocabulary, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = make_sequence([0], seed=3)
    script = {(k, c): n for k in (28, 29) for c, n in ((k - 25, 60), (10, 130))}
    results = answers_of(sequence, vocabulary, monkeypatch, script, wrong={10})
    assert results[28].rejected == ((3, 0.5, "not_confirmed_yet"), (10, 0.5, "against_odometry"))
    assert results[29].candidate_kf_id == 4 and results[29].rejected == ((10, 0.5, "against_odometry"),)


def test_a_loop_may_contradict_odometry_that_is_in_doubt(
    vocabulary: voc.Vocabulary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five metres off: the pose may have followed somebody before keyframe 20."""
    sequence = make_sequence([0], seed=3)
    script = {(k, c): 60 for k in (28, 29) for c in (9, 10)}
    doubt = np.array([2.0**2, 0.0])
    keyframes = [dataclasses.replace(k, doubt=doubt) if k.kf_id == 20 else k for k in sequence.keyframes]
    refused = answers_of(sequence, vocabulary, monkeypatch, script, wrong={9, 10})
    accepted = answers_of(sequence, vocabulary, monkeypatch, script, wrong={9, 10}, keyframes=keyframes)
    assert all(reason == "against_odometry" for r in refused[28:30] for _, _, reason in r.rejected)
    assert [r.candidate_kf_id for r in refused[28:30]] == [-1, -1]
    assert accepted[29].candidate_kf_id in (9, 10)


def test_two_places_without_a_path_between_them_are_ambiguous(
    vocabulary: voc.Vocabulary, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = make_sequence([0], seed=3)
    anew = [dataclasses.replace(k, submap_id=int(k.kf_id >= 20), stamp_ns=0) for k in sequence.keyframes]
    one, other = {(25, 5): 200, (26, 6): 210}, {(26, 12): 205}
    alone = answers_of(sequence, vocabulary, monkeypatch, one, set(), anew)
    assert alone[25].reason == "not_confirmed_yet" and alone[26].candidate_kf_id == 6
    both = answers_of(sequence, vocabulary, monkeypatch, one | other, {12}, anew)
    assert both[26].candidate_kf_id == -1 and [why for _, _, why in both[26].rejected] == ["ambiguous"] * 2


@pytest.mark.parametrize(("share", "accepted"), [(0.3, False), (0.5, True)])
def test_lamps_that_agree_join_no_submaps_where_the_shelves_beside_do_not(
    vocabulary: voc.Vocabulary, monkeypatch: pytest.MonkeyPatch, share: float, accepted: bool
) -> None:
    sequence = make_sequence([0], seed=3)
    anew = [dataclasses.replace(k, submap_id=int(k.kf_id >= 20), stamp_ns=0) for k in sequence.keyframes]
    monkeypatch.setattr(LoopCloser, "_agreeing_share", lambda *_: share)
    results = answers_of(sequence, vocabulary, monkeypatch, {(25, 5): 200, (26, 6): 210}, set(), anew)
    assert (results[26].candidate_kf_id == 6) == accepted
    assert results[26].reason == ("" if accepted else "not_confirmed_yet")


@pytest.mark.parametrize(("share", "accepted"), [(0.48, False), (0.6, True)])
def test_a_place_of_another_session_must_look_more_alike_than_wrong_ones_did(
    vocabulary: voc.Vocabulary, monkeypatch: pytest.MonkeyPatch, share: float, accepted: bool
) -> None:
    """A place that is 5 m off, long before, had 45 % of a keyframe's corners."""
    sequence = make_sequence([0, 1], seed=3)
    anew = [dataclasses.replace(k, submap_id=int(k.kf_id >= 20), stamp_ns=0) for k in sequence.keyframes]
    monkeypatch.setattr(
        LoopCloser, "_agreeing_share", lambda self, keyframe, candidate, _: 0.45 if candidate == 12 else share
    )
    one, other = [k.kf_id for k in anew if k.kf_id > 25 and k.described][GAP_WINDOW : GAP_WINDOW + 2]
    script = {(25, 12): 205, (one, 5): 200, (other, 6): 210}
    results = answers_of(sequence, vocabulary, monkeypatch, script, {12}, anew)
    assert results[25].reason == "not_confirmed_yet"
    assert results[other].reason == ("" if accepted else "ambiguous")


def test_pause_after_a_loop(vocabulary: voc.Vocabulary) -> None:
    results = close(make_sequence([0, 0], seed=5), vocabulary, dataclasses.replace(LoopConfig(), pause=7))
    accepted = [r.kf_id for r in results if r.candidate_kf_id >= 0]
    assert len(accepted) >= 2
    assert min(np.diff(accepted)) > 7
    assert all(results[accepted[0] + i].reason == "paused" for i in range(1, 8))


def test_a_new_submap_is_searched_although_a_loop_was_just_closed(vocabulary: voc.Vocabulary) -> None:
    sequence = make_sequence([0, 0], seed=5)
    loop = next(r.kf_id for r in close(sequence, vocabulary) if r.candidate_kf_id >= 0)
    first = sequence.first(loop + 4)
    anew = [dataclasses.replace(k, submap_id=int(k.kf_id > loop + 1)) for k in first.keyframes]
    reasons = [r.reason for r in close(dataclasses.replace(first, keyframes=anew), vocabulary)[loop:]]
    assert reasons[:2] == ["", "paused"] and "paused" not in reasons[2:]


def test_disabled_gives_no_loop_for_every_keyframe(vocabulary: voc.Vocabulary) -> None:
    results = close(make_sequence([0], seed=5), vocabulary, dataclasses.replace(LoopConfig(), enabled=False))
    assert {r.reason for r in results} == {"disabled"}


def test_same_sequence_same_bits(vocabulary: voc.Vocabulary) -> None:
    def bits() -> list[bytes]:
        return [
            r.candidate_T_kf.tobytes() + r.matches.tobytes() + r.information.tobytes() + repr(r.rejected).encode()
            for r in close(make_sequence([0, 0], seed=6), vocabulary)
        ]

    assert bits() == bits()


def test_keyframes_without_corners_are_no_places(vocabulary: voc.Vocabulary) -> None:
    """Every second keyframe is not described: loops are found by the others, and only to the others."""
    sequence = make_sequence([0, 0], seed=6)
    closer = LoopCloser(LoopConfig(), sequence.rig, vocabulary)
    none = Corners.none()
    results = [
        closer.step(dataclasses.replace(k, corners=none, sides=none) if k.kf_id % 2 else k) for k in sequence.keyframes
    ]
    loops = [r for r in results if r.candidate_kf_id >= 0]
    assert loops
    assert all(r.candidate_kf_id % 2 == 0 and r.kf_id % 2 == 0 and error_of(sequence, r) < 0.05 for r in loops)
    assert {r.reason for r in results if r.kf_id % 2} == {"not_described"}


def check_forgotten(closer: LoopCloser, results: list[LoopResult]) -> None:
    """Every keyframe is a candidate, among the newest, or forgotten once, and no later result names it then."""
    forgotten = list[int]()
    for r in results:
        named = {r.kf_id, r.candidate_kf_id, *(k for k, *_ in r.rejected), *r.sightings[:, 1].tolist()}
        assert not named & set(forgotten)
        forgotten += r.forgotten_kf_ids.tolist()
    assert len(set(forgotten)) == len(forgotten) > 0
    newest = range(len(results) - PASSED, len(results))
    assert {*forgotten, *closer._store.ids, *newest} == set(range(len(results)))


def test_of_a_view_seen_every_lap_a_few_keyframes_are_kept_and_loops_still_found(vocabulary: voc.Vocabulary) -> None:
    sequence = make_sequence([0, 1] * 7, seed=3)
    closer = LoopCloser(LoopConfig(), sequence.rig, vocabulary)
    results, keyframe_count = list[LoopResult](), list[int]()
    for keyframe in sequence.keyframes:
        results.append(closer.step(keyframe))
        keyframe_count.append(len(closer._store))
    lap = len(sequence.keyframes) // 7
    described = sum(keyframe.described for keyframe in sequence.keyframes[: lap + 1])
    assert keyframe_count[lap] == described  # nothing is forgotten on the first lap
    assert keyframe_count[-1] - keyframe_count[-1 - lap] < 0.3 * lap  # hardly anything is added on the last
    assert len(closer._database) <= 2 * len(closer._store) + PASSED + 1  # what is forgotten takes no room
    check_forgotten(closer, results)
    assert any(r.candidate_kf_id >= 0 for r in results[-lap:])
    assert all(error_of(sequence, r) < 0.1 for r in results if r.candidate_kf_id >= 0)


def test_of_many_views_seen_every_lap_a_limited_number_is_kept_besides_the_first(
    vocabulary: voc.Vocabulary, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stereo_sfm.loop.closer.OF_EARLIER_VISITS", 5)
    sequence = make_sequence([0, 1] * 7, seed=3)
    closer = LoopCloser(LoopConfig(), sequence.rig, vocabulary)
    results, keyframe_count = list[LoopResult](), list[int]()
    for keyframe in sequence.keyframes:
        results.append(closer.step(keyframe))
        keyframe_count.append(len(closer._store))
    lap = len(sequence.keyframes) // 7
    assert keyframe_count[lap] == sum(keyframe.described for keyframe in sequence.keyframes[: lap + 1])
    assert keyframe_count[-1] < 1.2 * keyframe_count[lap] + 5 + PASSED  # three times as many without
    assert any(r.candidate_kf_id >= 0 for r in results[-lap:])
    assert all(error_of(sequence, r) < 0.1 for r in results if r.candidate_kf_id >= 0)


def test_a_new_submap_is_connected_at_once_with_the_place_just_left(vocabulary: voc.Vocabulary) -> None:
    """After a moment of darkness the new submap is connected at once, not only after another lap."""
    sequence = make_sequence([0], seed=3)
    break_at = 20
    astray = se3.exp(np.array([5.0, 1, -8, 0.2, 1.0, 0]))
    keyframes = [
        k
        if i < break_at
        else dataclasses.replace(k, submap_id=1, odom_T_cam=astray @ k.odom_T_cam, point_ids=k.point_ids + 10**6)
        for i, k in enumerate(sequence.keyframes[: break_at + 8])
    ]
    loops = [r for r in close(dataclasses.replace(sequence, keyframes=keyframes), vocabulary) if r.candidate_kf_id >= 0]
    assert loops and loops[0].candidate_kf_id < break_at <= loops[0].kf_id < break_at + 5
    assert all(error_of(sequence, loop) < 0.05 for loop in loops)


@pytest.mark.parametrize(
    ("inliers", "rival", "astray", "reason"),
    [
        (200, 0, 0.0, ""),  # one keyframe joins
        (100, 0, 0.0, "not_confirmed_yet"),  # a share of a third, by chance perhaps
        (200, 130, 0.0, "ambiguous"),  # another place looks nearly alike
        (200, 0, 0.9, "not_confirmed_yet"),  # possible if the poses before the gap were disturbed
        (200, 0, 3.0, "out_of_reach"),
    ],
)
def test_one_keyframe_joins_a_new_submap_if_its_evidence_is_strong(
    vocabulary: voc.Vocabulary,
    monkeypatch: pytest.MonkeyPatch,
    inliers: int,
    rival: int,
    astray: float,
    reason: str,
) -> None:
    """Half a second of darkness; the views of the place just left agree at once, or 0.9 or 3 m beside."""
    sequence = make_sequence([0], seed=3)
    anew = [
        dataclasses.replace(k, submap_id=int(k.kf_id >= 20), stamp_ns=k.kf_id * 10**9 // 2) for k in sequence.keyframes
    ]
    beside = se3.exp(np.array([astray, 0, 0, 0, 0, 0]))
    answers = {(21, 15): (inliers, beside)}
    answers |= {(21, 10): (rival, se3.exp(np.array([0, 0, -0.5, 0, 0, 0])))} if rival else {}
    monkeypatch.setattr(LoopCloser, "_verify", scripted(sequence, answers))
    candidates = [Candidate(c, 0.5) for _, c in answers]
    monkeypatch.setattr(
        LoopCloser, "_candidates", lambda self, k, *_: (candidates if k.kf_id == 21 else [], "no_candidate")
    )
    result = close(dataclasses.replace(sequence, keyframes=anew), vocabulary)[21]
    assert result.reason == reason
    assert result.candidate_kf_id == (-1 if reason else 15)


def test_a_new_submap_in_a_twin_aisle_is_not_connected_with_the_first_aisle(vocabulary: voc.Vocabulary) -> None:
    """Dark between two identical aisles: the robot cannot have returned as fast as the images suggest."""
    sequence = make_sequence([0, 1], alike=1.0, seed=0)
    turned = next(i for i, pose in enumerate(sequence.world_T_kf) if pose[0, 3] > 1.0)
    rest = sequence.keyframes[turned + 2 :]
    begin = se3.inverse(rest[0].odom_T_cam)
    keyframes = sequence.keyframes[:turned] + [
        dataclasses.replace(k, submap_id=1, odom_T_cam=begin @ k.odom_T_cam, point_ids=k.point_ids + 10**6)
        for k in rest
    ]
    results = close(dataclasses.replace(sequence, keyframes=keyframes), vocabulary)
    across = [r for r in results if r.candidate_kf_id >= 0 and r.candidate_kf_id < turned < r.kf_id]
    assert all(error_of(sequence, r) < 0.1 for r in across)
    assert any(reason == "out_of_reach" for r in results for _, _, reason in r.rejected)
