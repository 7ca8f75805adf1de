"""The map's bookkeeping against plain sets that are recomputed from its observation table."""

from __future__ import annotations

import dataclasses
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_sfm.config import MapperConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.mapping import window
from stereo_sfm.mapping.map import Map
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.types import I64, Keyframe


def keyframe(kf_id: int, point_ids: I64, submap: int = 0) -> Keyframe:
    n = len(point_ids)
    rng = np.random.default_rng(kf_id)
    return Keyframe(
        kf_id=kf_id,
        frame_id=10 * kf_id,
        stamp_ns=kf_id * 10**9,
        odom_T_cam=se3.exp(np.array([0.1 * kf_id, 0, 0, 0, 0, 0.01 * kf_id])),
        point_ids=np.asarray(point_ids, np.int64),
        uv_left=rng.uniform(0, 600, (n, 2)),
        uv_right=rng.uniform(0, 600, (n, 2)),
        points_cam=rng.uniform(1, 3, (n, 3)),
        descriptors=rng.integers(0, 256, (n, 32), dtype=np.uint8),
        submap_id=submap,
    )


def insert(m: Map, kf: Keyframe) -> int:
    """A keyframe with all its points."""
    row = m.add_keyframe(kf, np.asarray(kf.odom_T_cam))
    known = m.point_rows(kf.point_ids) >= 0
    m.add_points(kf.point_ids[~known], se3.transform(kf.odom_T_cam, kf.points_cam[~known]), row)
    rows = m.point_rows(kf.point_ids)
    m.observe(row, rows, kf.uv_left, kf.uv_right, kf.descriptors)
    return row


def test_points_of_a_snapshot_are_in_order_of_their_ids() -> None:
    """Trackers may number the points of a keyframe in any order."""
    m = Map()
    insert(m, keyframe(0, np.array([7, 3, 9])))
    insert(m, keyframe(1, np.array([9, 1, 7])))
    s = m.snapshot()
    assert s.pt_ids.tolist() == [1, 3, 7, 9]
    for k, ids in enumerate(([7, 3, 9], [9, 1, 7])):
        assert s.pt_ids[s.obs_pt[s.obs_kf == k]].tolist() == ids
    assert np.array_equal(s.points, m.points.xyz[m.point_rows(s.pt_ids)])


def check(m: Map) -> None:
    """Lists, counts and covisibility agree with the observation table."""
    table = m.observations
    live = np.flatnonzero(table.pt >= 0)
    for p in range(len(m.points)):
        mine = live[table.pt[live] == p]
        assert np.array_equal(np.sort(m.sightings(np.array([p]))[0]), mine)
        assert m.points.obs_count[p] == len(mine)
        standing = int(m.points.descriptor_obs[p])
        if m.points.alive[p] and len(mine):
            assert standing in mine
    size = len(m.keyframes)
    expected = np.zeros((size, size), int)
    for p in range(len(m.points)):
        seen = table.kf[live[table.pt[live] == p]]
        assert len(set(seen.tolist())) == len(seen)
        for a in seen:
            for b in seen:
                expected[a, b] += a != b
    for row in range(size):
        for least in (1, 2, 3):
            sharing = np.flatnonzero(expected[row] >= least).tolist()
            assert m.neighbours(row, least).tolist() == sorted(sharing, key=lambda k: (-expected[row, k], k))


def edit(m: Map, rng: np.random.Generator) -> None:
    """Random operations of a mapper on a map."""
    choice = rng.integers(0, 6)
    next_kf = len(m.keyframes)
    if choice < 3 or next_kf < 2:
        start = next_kf * 4
        rows = m.point_rows(rng.integers(0, max(start, 1), 6))
        known = np.unique(m.points.pt_id[rows[rows >= 0]]) if next_kf else np.zeros(0, np.int64)
        known = known[m.points.alive[m.point_rows(known)]] if len(known) else known
        insert(m, keyframe(next_kf, np.unique(np.concatenate([known, start + np.arange(4)]))))
    elif choice == 3:
        m.cull_points(m.point_rows(rng.integers(0, 4 * next_kf, 2)))
    elif choice == 4:
        alive = m.points.pt_id[m.points.alive]
        if len(alive) > 2:
            old, new = m.point_rows(rng.choice(alive, 2, replace=False)).tolist()
            name = m.points.pt_id[[old]]
            m.fuse(old, new)
            assert m.point_rows(name)[0] == new
    else:
        row = int(rng.integers(0, next_kf))
        if 0 < row < next_kf - 1 and m.keyframes.alive[row]:  # the first and the newest one stay
            m.cull_keyframe(row)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_random_edits_keep_every_index_consistent(seed: int) -> None:
    rng = np.random.default_rng(seed)
    m = Map()
    for _ in range(25):
        edit(m, rng)
    check(m)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_a_compacted_map_is_the_same_map(seed: int) -> None:
    """The same edits, once with compaction now and then: same snapshots, ids and lists."""
    a, b = Map(), Map()
    for step in range(40):
        for m in (a, b):
            edit(m, np.random.default_rng([seed, step]))
        if step % 7 == 6:
            rows = np.arange(len(b.points))
            names, living = b.points.pt_id.copy(), b.points.alive.copy()
            now = b.compact()
            assert np.array_equal(b.points.pt_id[now[rows[living]]], names[living])
            assert (~b.points.alive).sum() <= 1
            assert (b.observations.pt >= 0).all()
    check(b)
    for field in dataclasses.fields(MapSnapshot):
        assert np.array_equal(getattr(a.snapshot(), field.name), getattr(b.snapshot(), field.name)), field.name
    ids = np.arange(4 * len(a.keyframes) + 3)
    rows_a, rows_b = a.point_rows(ids), b.point_rows(ids)
    assert np.array_equal(rows_a >= 0, rows_b >= 0)
    known = rows_a >= 0
    assert np.array_equal(a.points.alive[rows_a[known]], b.points.alive[rows_b[known]])
    living = known & a.points.alive[rows_a]
    assert np.array_equal(a.points.pt_id[rows_a[living]], b.points.pt_id[rows_b[living]])


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_a_map_without_the_rows_of_forgotten_keyframes_is_the_same_map(seed: int) -> None:
    """Edits, then the same insertions with and without these rows: same snapshots and poses."""
    a, b = Map(), Map()
    for m in (a, b):
        for step in range(40):
            edit(m, np.random.default_rng([seed, step]))
        m.take_delta()
    dead = np.flatnonzero(~b.keyframes.alive[:-1])
    b.forget(b.keyframes.kf_id[np.append(dead[::2], 0)])
    b.forget(np.array([10**6]))  # never seen
    now = b.free_keyframes()
    stay = np.flatnonzero(now >= 0)
    assert len(b.keyframes) == len(a.keyframes) - len(dead[::2])
    assert np.array_equal(b.keyframes.kf_id, a.keyframes.kf_id[stay])
    assert np.array_equal(b.keyframe_poses(), a.keyframe_poses()[stay])
    for row in dead[::2].tolist():
        freed = int(a.keyframes.kf_id[row])
        with pytest.raises(StereoSfmError, match="no keyframe"):
            b.kf_row(freed)
        later = b.keyframes.kf_id[b.row_since(freed)]  # the last one is never freed
        assert later > freed and not ((b.keyframes.kf_id > freed) & (b.keyframes.kf_id < later)).any()
    new = 4 * len(a.keyframes)
    for k in range(len(a.keyframes), len(a.keyframes) + 3):
        for m in (a, b):
            insert(m, keyframe(k, np.union1d(m.points.pt_id[m.living_points()], np.arange(new, new + 4))))
        new += 4
    for field in dataclasses.fields(MapSnapshot):
        assert np.array_equal(getattr(a.snapshot(), field.name), getattr(b.snapshot(), field.name)), field.name
    b.cull_keyframe(int(b.living_keyframes()[1]))
    check(b)


def test_rows_are_freed_when_most_are_removed() -> None:
    m = Map()
    for k in range(40):
        insert(m, keyframe(k, np.arange(200 * k, 200 * k + 200)))
        m.cull_points(m.point_rows(np.arange(200 * k, 200 * k + 150)))
    assert m.much_removed
    before = len(pickle.dumps(m))
    m.compact()
    assert not m.much_removed
    assert len(pickle.dumps(m)) < before / 2


def test_ids_of_culled_points_are_forgotten_unless_they_are_still_followed() -> None:
    m = Map()
    insert(m, keyframe(0, np.arange(9)))
    m.cull_points(np.array([2, 5]))
    m.compact(np.array([1, 5]))
    assert m.point_rows(np.array([2])).tolist() == [-1]
    assert m.point_rows(np.array([5]))[0] >= 0 and not m.points.alive[m.point_rows(np.array([5]))].any()
    living = np.array([0, 1, 3, 4, 6, 7, 8])
    assert m.points.pt_id[m.point_rows(living)].tolist() == living.tolist()


def test_ids_are_never_used_twice() -> None:
    m = Map()
    insert(m, keyframe(0, np.arange(5)))
    m.cull_points(np.array([2]))
    with pytest.raises(StereoSfmError, match="never used twice"):
        m.add_points(np.array([2]), np.zeros((1, 3)), 0)
    with pytest.raises(StereoSfmError, match="keyframe 0 is in the map already"):
        m.add_keyframe(keyframe(0, np.arange(2)), np.eye(4))
    with pytest.raises(StereoSfmError, match="no keyframe 9"):
        m.kf_row(9)


def test_fused_ids_follow_chains() -> None:
    m = Map()
    insert(m, keyframe(0, np.array([0, 1])))
    insert(m, keyframe(1, np.array([2, 3])))
    m.fuse(0, 2)
    m.fuse(2, 1)
    assert m.point_rows(np.array([0, 1, 2, 3, 77, -1])).tolist() == [1, 1, 1, 3, -1, -1]


def test_points_follow_their_anchors() -> None:
    m = Map()
    insert(m, keyframe(0, np.arange(4)))
    insert(m, keyframe(1, np.arange(2, 8)))
    before = m.keyframes.map_T_kf.copy()
    local = [
        se3.transform(se3.inverse(before[a]), x[None])[0] for a, x in zip(m.points.anchor, m.points.xyz, strict=True)
    ]
    after = before.copy()
    after[1] = se3.exp(np.array([1.0, -2, 0.5, 0.3, 0.2, -0.1])) @ before[1]
    m.move_keyframes(np.array([1]), after[[1]])
    m.carry_points(before, after)
    again = [
        se3.transform(se3.inverse(after[a]), x[None])[0] for a, x in zip(m.points.anchor, m.points.xyz, strict=True)
    ]
    np.testing.assert_allclose(again, local, atol=1e-12)


def test_deltas_contain_each_change_once() -> None:
    m = Map()
    insert(m, keyframe(0, np.arange(4)))
    kf, _, pt = m.take_delta()
    assert kf.tolist() == [0] and pt.tolist() == [0, 1, 2, 3]
    assert not any(len(rows) for rows in m.take_delta())
    m.move_points(np.array([1, 3]), np.ones((2, 3)))
    m.cull_points(np.array([3]))
    kf, _, pt = m.take_delta()
    assert pt.tolist() == [1] and len(kf) == 0


def test_a_point_stays_where_its_new_position_is_no_place() -> None:
    m = Map()
    insert(m, keyframe(0, np.arange(5)))
    m.take_delta()
    before = m.points.xyz.copy()
    moved = np.array([[1.0, 1, 1], [1, np.nan, 1], [1, 1, np.inf], [1, -1e18, 1]])
    m.move_points(np.arange(4), moved)
    assert m.points.xyz[0].tolist() == [1, 1, 1] and np.array_equal(m.points.xyz[1:], before[1:])
    assert m.take_delta()[2].tolist() == [0]


def test_culled_keyframe_leaves_the_chain_and_its_points_find_another_anchor() -> None:
    m = Map()
    for k in range(3):
        insert(m, keyframe(k, np.array([0, 10 + k])))
    m.cull_keyframe(0)
    assert m.keyframes.previous.tolist() == [-1, -1, 1]
    assert int(m.points.anchor[m.point_rows(np.array([0]))[0]]) == 1
    snap = m.snapshot()
    assert snap.kf_ids.tolist() == [1, 2]
    assert (snap.obs_kf < 2).all()
    assert (snap.anchors >= 0).all()  # point 10, which nobody sees now, goes with the reference


def test_culled_keyframes_move_with_their_carriers_and_are_reported_once() -> None:
    m = Map()
    for k in range(4):
        insert(m, keyframe(k, np.array([0, 10 + k])))
    poses = m.keyframes.map_T_kf.copy()
    m.cull_keyframe(1)  # carried by 0, which shares point 0, then with 0 by the next
    m.cull_keyframe(0)
    kf, culled, _ = m.take_delta()
    assert culled.tolist() == [1, 0] and kf.tolist() == [2, 3]
    reference = int(m.keyframes.reference[0])
    assert m.keyframes.reference[1] == reference and m.keyframes.alive[reference]
    np.testing.assert_allclose(m.keyframe_poses(), poses, atol=1e-12)
    move = se3.exp(np.array([1.0, -2, 0.5, 0.3, 0.2, -0.1]))
    m.move_keyframes(np.array([reference]), (move @ poses[reference])[None])
    np.testing.assert_allclose(m.keyframe_poses()[:2], move @ poses[:2], atol=1e-12)
    kf, culled, _ = m.take_delta()
    assert kf.tolist() == [reference] and len(culled) == 0  # what is carried costs nothing


def test_neighbours_come_in_order() -> None:
    m = Map()
    insert(m, keyframe(0, np.arange(0, 5)))
    insert(m, keyframe(1, np.arange(0, 9)))
    insert(m, keyframe(2, np.arange(4, 9)))
    insert(m, keyframe(3, np.array([0, 5, 8])))
    assert m.neighbours(1).tolist() == [0, 2, 3]
    assert m.neighbours(1, at_least=5).tolist() == [0, 2] and not len(m.neighbours(1, at_least=6))
    assert m.neighbours(3, at_least=2).tolist() == [1, 2]


def test_a_window_holds_only_the_fixed_keyframes_that_share_most_points() -> None:
    m = Map()
    for k in range(30):
        insert(m, keyframe(k, np.unique([*range(5), *range(5 + k, 25 + k)])))
    part = window.covisible_window(m, 29, MapperConfig(window_keyframes=3, fixed_keyframes=4, connected_points=5))
    assert part.kf_rows.tolist() == [27, 28, 29, 23, 24, 25, 26]
    assert part.bundle.fixed.tolist() == [False] * 3 + [True] * 4
    assert set(part.kf_rows[part.bundle.obs_kf].tolist()) == set(part.kf_rows.tolist())
    assert np.array_equal(m.observations.kf[part.obs_rows], part.kf_rows[part.bundle.obs_kf])
    everything = window.covisible_window(m, 29, MapperConfig(window_keyframes=3, fixed_keyframes=0, connected_points=5))
    assert len(everything.kf_rows) == 30


@pytest.mark.parametrize("seed", range(5))
def test_in_each_unconnected_part_of_the_map_the_oldest_keyframe_is_fixed(seed: int) -> None:
    rng, m, count = np.random.default_rng(seed), Map(), 24
    part_of = rng.integers(0, 4, count)
    part_of[0] = 0
    for k in range(count):  # keyframes of a part share ten points with the one before them, others at most nine
        at = 1000 * part_of[k] + 10 * int((part_of[:k] == part_of[k]).sum())
        insert(m, keyframe(k, np.concatenate([at + np.arange(20), 9000 + np.arange(9)])))
    fixed = window.whole_map(m).bundle.fixed
    oldest = [int(np.flatnonzero(part_of == p)[0]) for p in np.unique(part_of)]
    assert np.flatnonzero(fixed).tolist() == sorted(oldest)
