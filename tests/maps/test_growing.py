"""A saved map that a session is joined with as it goes on, against the same joined at its end."""

from __future__ import annotations

import dataclasses
import weakref

import numpy as np
import pytest

from stereo_sfm.config import Config, LoopConfig, MapperConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.loop import vocabulary as voc
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.maps.growing import GrowingMap
from stereo_sfm.maps.merge import subset
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.maps.update import Update, update
from stereo_sfm.types import U8, LoopResult
from tests.loop.store_sequence import StoreSequence, make_sequence
from tests.maps.maps import map_of_sequence


def first(saved: SavedMap, count: int) -> SavedMap:
    """The map as it was when it had so many keyframes."""
    s: MapSnapshot = saved.snapshot
    keyframes = np.arange(len(s.kf_ids)) < count
    obs = keyframes[s.obs_kf]
    points = np.bincount(s.obs_pt[obs], minlength=len(s.pt_ids)) > 0
    return dataclasses.replace(saved, snapshot=subset(s, keyframes, points, obs), sessions=saved.sessions[keyframes])


def two_drives() -> tuple[StoreSequence, StoreSequence, voc.Vocabulary]:
    """Through one aisle twice, each in its own frame."""
    whole = make_sequence([0, 0], seed=5, max_points=150)
    half = int(np.flatnonzero(np.diff((whole.world_T_kf[:, 2, 2] > 0.5).astype(int)) == 1)[0]) + 1
    parts = [
        dataclasses.replace(whole, keyframes=whole.keyframes[part], world_T_kf=whole.world_T_kf[part])
        for part in (slice(0, half), slice(half, None))
    ]
    return parts[0], parts[1], voc.train([k.descriptors for k in parts[0].keyframes], depth=3)


def second_drive() -> tuple[StoreSequence, StoreSequence, SavedMap, SavedMap, voc.Vocabulary, Update, LoopResult]:
    """Two drives, their maps, the vocabulary, both maps joined at the end, and a loop from the first to the second."""
    before, after, vocabulary = two_drives()
    saved, walk = map_of_sequence(before), map_of_sequence(after)
    done = update(saved, walk, vocabulary, LoopConfig(), MapperConfig())
    begins, points = (int(ids.max()) + 1 for ids in (saved.snapshot.kf_ids, saved.snapshot.pt_ids))
    loop = next(one for one in done.loops if one.candidate_kf_id < begins <= one.kf_id)
    place = dataclasses.replace(loop, kf_id=loop.kf_id - begins, matches=loop.matches - np.array([0, points]))
    return before, after, saved, walk, vocabulary, done, place


def test_a_session_is_joined_as_it_goes_on() -> None:
    before, after, saved, walk, vocabulary, done, place = second_drive()
    growing = GrowingMap(saved, vocabulary, Config())
    with pytest.raises(StereoSfmError, match="not found in the saved map yet"):
        growing.take(walk, None)
    begin = int(np.searchsorted(walk.snapshot.kf_ids, place.kf_id)) + 1
    for count in (begin, (begin + len(walk)) // 2, len(walk), len(walk)):
        growing.take(first(walk, count), place)
        assert len(growing.saved()) == len(saved) + count  # at once, without a search
    before_search = growing.saved().snapshot
    while growing.work():
        pass
    s = growing.saved()
    assert s.session_ids == done.saved.session_ids == [0, 1] and len(s) == len(done.saved)
    shared = len(before_search.pt_ids) - len(s.snapshot.pt_ids)
    assert shared > 0.7 * done.fused  # what both drives saw is one
    poses = np.concatenate([before.world_T_kf, after.world_T_kf])
    true = se3.inverse(poses[0]) @ poses
    errors = [
        np.quantile(se3.extent(se3.inverse(true) @ one.map_T_kf), 0.95, axis=1)
        for one in (before_search, s.snapshot, done.saved.snapshot)
    ]
    assert (errors[0] < [0.03, np.radians(0.3)]).all() and (errors[1] < np.maximum(1.2 * errors[2], 0.004)).all()
    joining = growing._joining  # pyright: ignore[reportPrivateUsage]
    gone = first(walk, int(np.searchsorted(walk.snapshot.kf_ids, place.kf_id)) + 1)  # the session culled the rest
    ends = {kf_id for loop in joining.loops for kf_id in (loop.candidate_kf_id, loop.kf_id)}
    growing.take(gone, place)
    assert len(growing.saved()) == len(saved) + len(gone)
    left = {kf_id for loop in joining.loops for kf_id in (loop.candidate_kf_id, loop.kf_id)}
    assert left and left < ends and all(joining.map.keyframes.alive[joining.map.kf_row(kf_id)] for kf_id in left)


def test_points_are_expected_as_often_as_in_the_session() -> None:
    """Also those joined before: `map prune --min-seen-share` compares that with how often they were seen."""
    _, _, saved, walk, vocabulary, _, place = second_drive()
    growing, s = GrowingMap(saved, vocabulary, Config()), walk.snapshot
    growing.take(first(walk, int(np.searchsorted(s.kf_ids, place.kf_id)) + 1), place)
    growing.take(dataclasses.replace(walk, snapshot=dataclasses.replace(s, expected=3 * s.seen)), place)
    map_ = growing._map  # pyright: ignore[reportPrivateUsage]
    rows = map_.living_points()
    rows = rows[map_.points.pt_id[rows] > saved.snapshot.pt_ids.max()]  # not one with a point of the saved map
    assert len(rows) and np.array_equal(map_.points.expected[rows], 3 * map_.points.seen[rows])


def test_what_the_session_culled_takes_no_memory() -> None:
    _, _, saved, walk, vocabulary, _, place = second_drive()
    growing, begin = (
        GrowingMap(saved, vocabulary, Config()),
        int(np.searchsorted(walk.snapshot.kf_ids, place.kf_id)) + 1,
    )
    growing.take(walk, place)
    map_ = growing._map  # pyright: ignore[reportPrivateUsage]
    rows = len(map_.observations), len(map_.points)
    growing.take(first(walk, begin), place)
    assert not map_.much_removed and len(map_.observations) < 0.8 * rows[0] and len(map_.points) < 0.8 * rows[1]
    assert not any(map(len, map_.take_delta()))
    queued = [keyframe.kf_id for keyframe in growing._queue]  # pyright: ignore[reportPrivateUsage]
    assert len(queued) == begin
    while growing.work():
        pass
    s, once = growing.saved().snapshot, GrowingMap(saved, vocabulary, Config())
    once.take(first(walk, begin), place)
    while once.work():
        pass
    assert len(s.kf_ids) == len(saved) + begin and len(s.pt_ids) == len(once.saved().snapshot.pt_ids)


def test_a_session_that_goes_round_all_day_takes_no_more_memory() -> None:
    """Its map keeps the newest round; what the joined map searches in and holds does not grow, and links stay."""
    rounds = 7
    whole = make_sequence([0] * (rounds + 1), seed=5, max_points=100)
    half = len(whole.keyframes) // (rounds + 1)
    before, after = (
        dataclasses.replace(whole, keyframes=whole.keyframes[part], world_T_kf=whole.world_T_kf[part])
        for part in (slice(0, half), slice(half, None))
    )
    vocabulary = voc.train([k.descriptors for k in before.keyframes], depth=3)
    saved, walk = map_of_sequence(before), map_of_sequence(after)
    done = update(saved, first(walk, half), vocabulary, LoopConfig(), MapperConfig())
    begins, points = (int(ids.max()) + 1 for ids in (saved.snapshot.kf_ids, saved.snapshot.pt_ids))
    loop = next(one for one in done.loops if one.candidate_kf_id < begins <= one.kf_id)
    place = dataclasses.replace(loop, kf_id=loop.kf_id - begins, matches=loop.matches - np.array([0, points]))
    growing, sizes, links = GrowingMap(saved, vocabulary, Config()), list[int](), list[int]()
    parts = list[weakref.ref[U8]]()
    for end in range(half, len(walk), half // 2):
        s = walk.snapshot
        newest = (np.arange(len(s.kf_ids)) < end) & (np.arange(len(s.kf_ids)) >= end - half)
        obs = newest[s.obs_kf]
        seen = np.bincount(s.obs_pt[obs], minlength=len(s.pt_ids)) > 0
        part = dataclasses.replace(walk, snapshot=subset(s, newest, seen, obs), sessions=walk.sessions[newest])
        parts.append(weakref.ref(part.snapshot.corner_descriptors))
        growing.take(part, place)
        while growing.work():
            pass
        closer = growing._closer  # pyright: ignore[reportPrivateUsage]
        assert closer is not None
        sizes.append(len(closer._store))  # pyright: ignore[reportPrivateUsage]
        links.append(len(growing._joining.loops))  # pyright: ignore[reportPrivateUsage]
        assert len(growing.saved()) == len(saved) + half
    assert [part() is not None for part in parts] == [False] * (len(parts) - 1) + [True]
    assert len(sizes) >= 10 and max(sizes[1:]) <= 1.1 * sizes[0] and min(links) > 0 and max(links) <= half
