"""Corners that a loop across directions matched, as points of the map that keyframes of both directions observe."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereo_sfm.config import LoopConfig, MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop.closer import LoopCloser
from stereo_sfm.loop.vocabulary_file import default_vocabulary
from stereo_sfm.mapping.map import Map
from stereo_sfm.mapping.mapper import Mapper
from stereo_sfm.mapping.side_points import join_corners
from stereo_sfm.maps.saved_map import restore_map
from stereo_sfm.types import F64, I64, Keyframe, LoopResult, MapUpdate
from tests.loop.test_sideways import RIG, drive, path, shelves

Drive = tuple[F64, list[Keyframe], list[LoopResult]]


@pytest.fixture(scope="module")
def there_and_back() -> Drive:
    rng, poses = np.random.default_rng(1), path(0)
    keyframes = [  # corners are seldom at just the pixel of a tracked point
        dataclasses.replace(k, uv_left=k.uv_left + 0.01) for k in drive(poses, *shelves(1, False, rng), rng)
    ]
    closer = LoopCloser(LoopConfig(), RIG, default_vocabulary())
    return poses, keyframes, [closer.step(k) for k in keyframes]


def mapped(keyframes: list[Keyframe], loops: list[LoopResult]) -> tuple[Mapper, list[MapUpdate]]:
    mapper = Mapper(MapperConfig(redundant_share=2), RIG)
    updates = [mapper.step(k, loop) for k, loop in zip(keyframes, [None, *loops[:-1]], strict=True)]
    last = mapper.finish(loops[-1:])
    assert last is not None
    return mapper, [*updates, last]


def misfit(map_: Map, poses: F64, loops: list[LoopResult]) -> float:
    """Largest error in metres between the two directions, over the keyframes of the loops."""
    found = map_.keyframe_poses()
    pairs = [(r.candidate_kf_id, r.kf_id) for r in loops if r.candidate_kf_id >= 0]
    off = [se3.inverse(se3.inverse(poses[a]) @ poses[b]) @ se3.inverse(found[a]) @ found[b] for a, b in pairs]
    return float(np.linalg.norm(np.array(off)[:, :3, 3], axis=1).max())


def test_bundle_adjustment_keeps_both_directions_together(there_and_back: Drive) -> None:
    poses, keyframes, loops = there_and_back
    blind = [dataclasses.replace(r, sightings=np.zeros((0, 3), np.int64)) for r in loops]
    kept, lost = (misfit(mapped(keyframes, r)[0].map, poses, loops) for r in (loops, blind))
    assert kept < 0.01 and kept < 0.5 * lost


def test_the_tracker_never_hears_of_these_points_and_a_saved_map_has_them(there_and_back: Drive) -> None:
    _, keyframes, loops = there_and_back
    mapper, updates = mapped(keyframes, loops)
    points = mapper.map.points
    mine = np.flatnonzero(points.alive & (points.pt_id < 0))
    assert len(mine) > 50 and (points.obs_count[mine] >= 2).all()
    for update in updates:
        for ids in (update.point_ids, update.culled_point_ids, update.fused_point_ids):
            assert (ids >= 0).all()
    snapshot = mapper.snapshot()
    assert (np.diff(snapshot.pt_ids) > 0).all() and snapshot.pt_ids[0] >= 0 and (np.diff(snapshot.obs_kf) >= 0).all()
    again = restore_map(snapshot).snapshot()
    for name in ("pt_ids", "points", "obs_kf", "obs_pt", "uv_left"):
        assert np.array_equal(getattr(again, name), getattr(snapshot, name)), name


def small_map(keyframes: list[Keyframe]) -> Map:
    map_ = Map()
    for k in keyframes:
        row = map_.add_keyframe(k, k.odom_T_cam)
        new = map_.point_rows(k.point_ids) < 0
        map_.add_points(k.point_ids[new], se3.transform(k.odom_T_cam, k.points_cam[new]), row)
        map_.observe(row, map_.point_rows(k.point_ids), k.uv_left, k.uv_right, k.descriptors)
    return map_


def observed(map_: Map) -> list[tuple[int, float, float]]:
    """Point and pixel of every observation."""
    table = map_.observations
    rows = np.concatenate([map_.observations_of_keyframe(k) for k in range(len(map_.keyframes))])
    return sorted(zip(table.pt[rows].tolist(), *table.uv_left[rows].T.tolist(), strict=True))


def test_a_corner_is_one_point_however_often_it_is_matched(there_and_back: Drive) -> None:
    keyframes = there_and_back[1]
    map_ = small_map(keyframes[:3])
    before, count = observed(map_), len(map_.points)
    sightings: I64 = np.array([[0, 0, 1], [0, 2, 5], [1, 1, 2], [1, 2, 6], [2, 1, 3]])
    assert not join_corners(map_, sightings, 1.0)
    for name in ("uv_left", "uv_right"):
        assert np.array_equal(
            getattr(map_.observations, name)[np.sort(map_.sightings(np.array([count]))[0])],
            [getattr(keyframes[0].sides, name)[1], getattr(keyframes[2].sides, name)[5]],
        )
    assert len(map_.points) == count + 2  # only one keyframe saw the third
    assert set(before) < set(observed(map_)) and len(observed(map_)) == len(before) + 4
    once = observed(map_)
    assert not join_corners(map_, sightings, 1.0) and observed(map_) == once
    more = np.array([[0, 0, 1], [0, 1, 9]])
    assert not join_corners(map_, more, 1.0) and map_.points.obs_count[count] == 3
    both = np.array([[0, 0, 1], [0, 1, 2]])  # two points turn out to be one, but keyframe 2 saw both
    assert not join_corners(map_, both, 1.0)
    at = map_.observations_of_keyframe(1)
    assert (map_.observations.kf[at] == 1).all() and len(at) == map_.keyframes.obs_count[1]
    assert map_.compact() is not None and len(observed(map_)) == len(once) + 1


def test_corners_of_removed_keyframes_are_left_out(there_and_back: Drive) -> None:
    map_ = small_map(there_and_back[1][:3])
    map_.cull_keyframe(1)
    join_corners(map_, np.array([[0, 0, 1], [0, 1, 5], [1, 1, 2], [1, 2, 6]]), 1.0)
    assert not (map_.points.pt_id < 0).any()
