"""Loops applied to the map of a synthetic sequence: poses, points, fusion, and the rejection of a false loop."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereo_sfm.config import LoopConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.correction import apply_loop
from stereo_sfm.mapping.map import Map
from stereo_sfm.types import F64, Keyframe, LoopResult
from tests.loop.store_sequence import StoreSequence, make_sequence


@pytest.fixture(scope="module")
def sequence() -> StoreSequence:
    return make_sequence([0, 0], seed=11)


def raw_map(sequence: StoreSequence) -> Map:
    """Keyframes at their odometry poses, points where their first keyframe observed them."""
    map_ = Map()
    for k in sequence.keyframes:
        row = map_.add_keyframe(k, k.odom_T_cam)
        new = map_.point_rows(k.point_ids) < 0
        map_.add_points(k.point_ids[new], se3.transform(k.odom_T_cam, k.points_cam[new]), row)
        rows = map_.point_rows(k.point_ids)
        map_.observe(row, rows, k.uv_left, k.uv_right, k.descriptors)
    return map_


def true_loop(sequence: StoreSequence, a: int, b: int) -> LoopResult:
    """The true loop between two keyframes, with the points that both observe."""
    seen = {sequence.physical[i]: i for i in sequence.keyframes[a].point_ids.tolist()}
    pairs = [
        (seen[sequence.physical[i]], i)
        for i in sequence.keyframes[b].point_ids.tolist()
        if sequence.physical[i] in seen
    ]
    return LoopResult(
        kf_id=b,
        candidate_kf_id=a,
        candidate_T_kf=se3.inverse(sequence.world_T_kf[a]) @ sequence.world_T_kf[b],
        information=np.eye(6) * 1e6,
        matches=np.array(pairs, np.int64).reshape(-1, 2),
        inliers=len(pairs),
        score=0.3,
        reason="",
    )


def ends(sequence: StoreSequence) -> tuple[int, int]:
    """The last keyframe, and the nearest one of the first visit."""
    b = len(sequence.keyframes) - 1
    distance = np.linalg.norm(sequence.world_T_kf[:30, :3, 3] - sequence.world_T_kf[b, :3, 3], axis=1)
    return int(distance.argmin()), b


def trajectory_error(map_: Map, truth: F64) -> float:
    moved = se3.transform(se3.inverse(truth[0]) @ truth, np.zeros((len(truth), 1, 3)))[:, 0]
    here = se3.inverse(map_.keyframes.map_T_kf[0]) @ map_.keyframes.map_T_kf
    return float(np.sqrt(((here[:, :3, 3] - moved) ** 2).sum(1).mean()))


def test_a_loop_removes_the_drift_and_moves_the_points(sequence: StoreSequence) -> None:
    map_ = raw_map(sequence)
    a, b = ends(sequence)
    before = trajectory_error(map_, sequence.world_T_kf)
    alive = len(map_.living_points())
    local = se3.transform(se3.inverse(map_.keyframes.map_T_kf[b]), map_.points.xyz[map_.points.anchor == b])
    loop = true_loop(sequence, a, b)
    done = apply_loop(map_, loop, [], LoopConfig())
    assert done.applied
    assert trajectory_error(map_, sequence.world_T_kf) < 0.7 * before
    relative = se3.inverse(map_.keyframes.map_T_kf[a]) @ map_.keyframes.map_T_kf[b]
    assert np.linalg.norm((se3.inverse(loop.candidate_T_kf) @ relative)[:3, 3]) < 0.02
    assert np.allclose(
        se3.transform(se3.inverse(map_.keyframes.map_T_kf[b]), map_.points.xyz[map_.points.anchor == b]), local
    )
    assert len(done.fused) == len(loop.matches) > 20
    assert len(map_.living_points()) == alive - len(done.fused)
    assert map_.neighbours(b).tolist().count(a) == 1  # the two sides now share points


def turning_sequence(degrees_per_100m: float, side_m: float = 30.0, step_m: float = 0.5) -> tuple[Map, F64]:
    """A map of keyframes around a square back to its beginning, whose heading drifts, and the truth of its poses."""
    truth, drifted = [np.eye(4)], [np.eye(4)]
    per_side = round(side_m / step_m)
    for k in range(4 * per_side):
        turn = np.pi / 2 if (k + 1) % per_side == 0 else 0.0
        ahead = se3.exp(np.array([0, 0, step_m, 0, 0, 0]))
        truth.append(truth[-1] @ ahead @ se3.exp(np.array([0, 0, 0, 0, turn, 0])))
        turn += np.radians(degrees_per_100m) / 100 * step_m
        drifted.append(drifted[-1] @ ahead @ se3.exp(np.array([0, 0, 0, 0, turn, 0])))
    map_ = Map()
    for k, pose in enumerate(drifted):
        ids = np.arange(20 * k, 20 * k + 100)  # 80 points shared with the keyframe before, 40 with the third
        seen = Keyframe(
            k, k, k, pose, ids, np.ones((100, 2)), np.ones((100, 2)), np.ones((100, 3)),
            np.ones((100, 32), np.uint8),
        )  # fmt: skip
        row = map_.add_keyframe(seen, pose)
        new = map_.point_rows(ids) < 0
        map_.add_points(ids[new], se3.transform(pose, np.ones((new.sum(), 3))), row)
        map_.observe(row, map_.point_rows(ids), seen.uv_left, seen.uv_right, seen.descriptors)
    return map_, np.array(truth)


@pytest.mark.parametrize("degrees_per_100m", [0.5, 2.0, 5.0])
def test_a_true_loop_is_accepted_after_systematic_heading_drift(degrees_per_100m: float) -> None:
    """Such errors accumulate: after 120 m the ends are 0.2 to 2.2 m apart, and the true loop is accepted."""
    map_, truth = turning_sequence(degrees_per_100m)
    last = len(truth) - 1
    before = trajectory_error(map_, truth)
    loop = LoopResult(
        last, 0, se3.inverse(truth[0]) @ truth[last], np.eye(6) * 1e6, np.zeros((0, 2), np.int64), 50, 0.3, ""
    )
    assert apply_loop(map_, loop, [], LoopConfig()).applied
    assert trajectory_error(map_, truth) < 0.4 * before


def test_a_loop_that_no_drift_explains_is_refused() -> None:
    """An identical next aisle: 1.5 m aside after 40 m."""
    map_, truth = turning_sequence(0.5, side_m=10.0)
    last = len(truth) - 1
    poses = map_.keyframes.map_T_kf.copy()
    aside = se3.inverse(truth[0]) @ truth[last] @ se3.exp(np.array([1.5, 0, 0, 0, 0, 0]))
    loop = LoopResult(last, 0, aside, np.eye(6) * 1e6, np.zeros((0, 2), np.int64), 50, 0.3, "")
    assert not apply_loop(map_, loop, [], LoopConfig()).applied
    assert np.array_equal(map_.keyframes.map_T_kf, poses)


def test_odometry_in_doubt_takes_the_error_of_a_loop(sequence: StoreSequence) -> None:
    """Without other errors, the pose followed somebody by half a metre before keyframe 60."""
    a, b = ends(sequence)
    truth, followed = sequence.world_T_kf, se3.exp(np.array([0.4, 0.0, 0.3, 0, 0, 0]))

    def error_after_loop(doubt: F64) -> float:
        keyframes = [
            dataclasses.replace(k, odom_T_cam=followed @ pose, doubt=doubt * (k.kf_id == 60))
            if k.kf_id >= 60
            else dataclasses.replace(k, odom_T_cam=pose)
            for k, pose in zip(sequence.keyframes, truth, strict=True)
        ]
        map_ = raw_map(dataclasses.replace(sequence, keyframes=keyframes))
        assert apply_loop(map_, true_loop(sequence, a, b), [], LoopConfig()).applied
        return trajectory_error(map_, truth)

    assert error_after_loop(np.array([0.5**2, 0.01**2])) < 0.2 * error_after_loop(np.zeros(2))


def test_false_loop_changes_nothing(sequence: StoreSequence) -> None:
    map_ = raw_map(sequence)
    a, b = ends(sequence)
    apply_loop(map_, true_loop(sequence, a, b), [], LoopConfig())
    poses, points = map_.keyframes.map_T_kf.copy(), map_.points.xyz.copy()
    false = dataclasses.replace(
        true_loop(sequence, a, b - 5), candidate_T_kf=se3.exp(np.array([1.5, 0, 1.0, 0, 0.3, 0]))
    )
    done = apply_loop(map_, false, [true_loop(sequence, a, b)], LoopConfig())
    assert not done.applied
    assert np.array_equal(map_.keyframes.map_T_kf, poses)
    assert np.array_equal(map_.points.xyz, points, equal_nan=True)


def test_averaging_satisfies_the_loop_exactly(sequence: StoreSequence) -> None:
    map_ = raw_map(sequence)
    a, b = ends(sequence)
    loop = true_loop(sequence, a, b)
    assert apply_loop(map_, loop, [], dataclasses.replace(LoopConfig(), correction="averaging")).applied
    relative = se3.inverse(map_.keyframes.map_T_kf[a]) @ map_.keyframes.map_T_kf[b]
    assert np.allclose(relative, loop.candidate_T_kf, atol=1e-9)


def test_unknown_correction_is_refused(sequence: StoreSequence) -> None:
    with pytest.raises(StereoSfmError, match=r"loop\.correction"):
        apply_loop(
            raw_map(sequence),
            true_loop(sequence, *ends(sequence)),
            [],
            dataclasses.replace(LoopConfig(), correction="magic"),
        )


@pytest.mark.parametrize("correction", ["pose_graph", "averaging"])
def test_a_loop_connects_a_submap_with_the_rest(sequence: StoreSequence, correction: str) -> None:
    """Tracking restarted: the odometry pose of the second submap is arbitrary."""
    a, b = ends(sequence)
    half = len(sequence.keyframes) // 2
    astray = se3.exp(np.array([5.0, 1, -8, 0.2, 1.0, 0]))
    pieces = [
        k if i < half else dataclasses.replace(k, submap_id=1, odom_T_cam=astray @ k.odom_T_cam)
        for i, k in enumerate(sequence.keyframes)
    ]
    lost = dataclasses.replace(sequence, keyframes=pieces)
    for k in range(half, len(pieces)):  # no track survives the break
        ids = pieces[k].point_ids + 10**6
        pieces[k] = dataclasses.replace(pieces[k], point_ids=ids)
    lost.physical.update({i + 10**6: p for i, p in sequence.physical.items()})
    map_ = raw_map(lost)
    config = dataclasses.replace(LoopConfig(), correction=correction)
    assert apply_loop(map_, true_loop(lost, a, b), [], config).applied
    assert trajectory_error(map_, sequence.world_T_kf) < 0.3


def test_same_map_same_bits(sequence: StoreSequence) -> None:
    def bits() -> bytes:
        map_ = raw_map(sequence)
        apply_loop(map_, true_loop(sequence, *ends(sequence)), [], LoopConfig())
        return map_.keyframes.map_T_kf.tobytes() + map_.points.xyz.tobytes()

    assert bits() == bits()


@pytest.mark.parametrize("off", [None, [5.0, 0.0, 0.0, 0.0, 1.5, 0.0]])
@pytest.mark.parametrize("bridged", [True, False])
def test_a_session_moves_as_a_whole_though_tracking_was_lost_in_it(
    sequence: StoreSequence, bridged: bool, off: list[float] | None
) -> None:
    """A saved map, and a session of two submaps, of which one shows a place of the map; the other goes with it.

    The second lies to the first as predicted, which may be far `off`: its own loop then puts it right.
    """
    a, b = ends(sequence)
    begin = len(sequence.keyframes) // 2
    cut = (begin + b) // 2
    astray, turned = se3.exp(np.array([5.0, 1, -8, 0.2, 1.0, 0])), se3.exp(np.array(off or [0.0] * 6))
    pieces = list[Keyframe]()
    physical = dict(sequence.physical)
    for k, keyframe in enumerate(sequence.keyframes):
        submap = int(k >= begin) + int(k >= cut)
        ids = keyframe.point_ids + submap * 10**6
        physical.update(zip(ids.tolist(), (sequence.physical[i] for i in keyframe.point_ids.tolist()), strict=True))
        pose = [np.eye(4), astray, astray @ turned][submap] @ keyframe.odom_T_cam
        pieces.append(dataclasses.replace(keyframe, submap_id=submap, odom_T_cam=pose, point_ids=ids))
    lost = dataclasses.replace(sequence, keyframes=pieces, physical=physical)
    map_ = raw_map(lost)
    bridges = (np.array([cut - 1]), np.array([cut])) if bridged else None
    first, second = true_loop(lost, a, b), true_loop(lost, 2, cut - 2)
    assert apply_loop(map_, first, [], LoopConfig(), bridges=bridges).applied
    assert (trajectory_error(map_, sequence.world_T_kf) < 0.3) == (bridged and off is None)
    assert apply_loop(map_, second, [first], LoopConfig(), bridges=bridges).applied
    assert trajectory_error(map_, sequence.world_T_kf) < 0.3


def test_a_loop_between_sessions_that_loops_alone_join_is_allowed_to_drift() -> None:
    """The session left the map's aisles and comes back 60 m later; its scale is off by what is usual."""
    map_, truth = turning_sequence(0.2)
    count = len(truth)
    cut = count // 4
    map_.keyframes.previous[cut] = -1  # another session begins, which shares no point with the one before
    ends_of = [(cut - 1, cut), (0, count - 1)]
    first, last = (
        LoopResult(
            kf_id=b, candidate_kf_id=a, candidate_T_kf=se3.inverse(truth[a]) @ truth[b], information=np.eye(6) * 1e6,
            matches=np.zeros((0, 2), np.int64), inliers=100, score=0.3, reason="",
        )
        for a, b in ends_of
    )  # fmt: skip
    assert apply_loop(map_, first, [], LoopConfig()).applied
    assert apply_loop(map_, last, [first], LoopConfig()).applied
