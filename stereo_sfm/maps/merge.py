"""Several walks of one store become one map: loops between them, one pose graph, full bundle adjustment."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import LoopConfig, MapperConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.loop.closer import LoopCloser
from stereo_sfm.loop.vocabulary import Vocabulary
from stereo_sfm.mapping import window
from stereo_sfm.mapping.bundle import bundle_adjust
from stereo_sfm.mapping.correction import apply_loop
from stereo_sfm.mapping.map import Map, MapSnapshot
from stereo_sfm.maps.saved_map import SavedMap, joined, restore_map
from stereo_sfm.types import I64, Bool, LoopResult

_MAPPER = MapperConfig()
log = logging.getLogger("stereo_sfm")
SAME_SHARE = 0.5  # of the pixels at common times: pictures taken twice have hardly any in common
MERGE_PAUSE = 2  # keyframes between two loops of a merge: every link between the walks helps


@dataclass(frozen=True, eq=False)
class Merge:
    """The common map and how it came about."""

    saved: SavedMap
    loops: list[LoopResult]  # applied, in ids of the common map
    fused: int  # points that became one with another


def merge(
    maps: Sequence[SavedMap],
    vocabulary: Vocabulary,
    config: LoopConfig,
    mapper: MapperConfig = _MAPPER,
    place: LoopResult | None = None,
) -> Merge:
    """One map of all; the first keeps its frame.

    Args:
        maps: two or more.
        vocabulary: of the search for loops. Maps keep their descriptors, so it need not be the one they were made with.
        config: of the loops.
        mapper: of the bundle adjustment at the end.
        place: a loop from the first map to the second that is known already, in the ids of each.

    Raises:
        StereoSfmError: other cameras, or a map that no loop joins to the rest.
    """
    side_by_side = joined(list(maps))
    map_ = restore_map(side_by_side.snapshot)
    map_.points.sigma[:] = map_.observations.sigma[:] = mapper.sigma_px  # what is fused from now on counts less
    closer = LoopCloser(dataclasses.replace(config, pause=MERGE_PAUSE), side_by_side.rig, vocabulary)
    walks, stamps = side_by_side.sessions, side_by_side.snapshot.stamp_ns
    begins = {k: int(stamps[walks == k].min()) for k in side_by_side.walks}  # clocks of walks have nothing in common
    loops: list[LoopResult] = []
    fused = 0
    if place is not None:
        raised = np.array([0, _ends(maps, "pt_ids")[0]])
        known = dataclasses.replace(
            place, kf_id=place.kf_id + int(_ends(maps, "kf_ids")[0]), matches=place.matches + raised
        )
        done = apply_loop(map_, known, [], config)
        if done.applied:
            loops.append(known)
            fused += len(done.fused)
    for keyframe, walk in zip(side_by_side.snapshot.keyframes(), walks.tolist(), strict=True):
        result = closer.step(dataclasses.replace(keyframe, stamp_ns=keyframe.stamp_ns - begins[walk]))
        if result.candidate_kf_id >= 0:
            done = apply_loop(map_, result, loops, config)
            if done.applied:
                loops.append(result)
                fused += len(done.fused)
    _check_joined(maps, loops)
    full_adjustment(map_, side_by_side.rig, mapper)
    snapshot = map_.snapshot()
    session = dict(zip(side_by_side.snapshot.kf_ids.tolist(), side_by_side.sessions.tolist(), strict=True))
    sessions = np.array([session[k] for k in snapshot.kf_ids.tolist()], np.int64)
    return Merge(SavedMap(snapshot, side_by_side.rig, vocabulary.id, sessions), loops, fused)


def share_a_walk(a: SavedMap, b: SavedMap) -> bool:
    """Whether a walk of one map is one of the other: the same pixels were seen at the same times.

    Times alone tell nothing, they begin at zero in many recordings.
    """
    return any(_same_walk(_sightings(a, m), _sightings(b, n)) for m in a.walks for n in b.walks)


def _sightings(saved: SavedMap, walk: int) -> dict[int, set[tuple[float, float]]]:
    """The pixels (as files hold them) of what the left eye saw in a walk, by the time of the keyframe."""
    s = saved.snapshot
    rows = np.flatnonzero((saved.sessions == walk)[s.obs_kf])
    out: dict[int, set[tuple[float, float]]] = {}
    for stamp, (u, v) in zip(s.stamp_ns[s.obs_kf[rows]].tolist(), s.uv_left[rows].astype(np.float32), strict=True):
        out.setdefault(stamp, set()).add((float(u), float(v)))
    return out


def _same_walk(a: dict[int, set[tuple[float, float]]], b: dict[int, set[tuple[float, float]]]) -> bool:
    times = a.keys() & b.keys()
    same = sum(len(a[t] & b[t]) for t in times)
    return same > SAME_SHARE * sum(min(len(a[t]), len(b[t])) for t in times)


def _ends(maps: Sequence[SavedMap], ids: str) -> I64:
    """(maps,) above which the ids of the next map begin when `joined` has raised them."""
    return np.cumsum([int(getattr(saved.snapshot, ids).max()) + 1 for saved in maps])


def _check_joined(maps: Sequence[SavedMap], loops: list[LoopResult]) -> None:
    """Every map must hang together with the first one."""
    ends = _ends(maps, "kf_ids")
    group = np.arange(len(maps))
    for loop in loops:
        a, b = group[np.searchsorted(ends, [loop.candidate_kf_id, loop.kf_id], side="right")]
        group[group == max(a, b)] = min(a, b)
    apart = len(np.unique(group))
    if apart > 1:
        raise StereoSfmError(
            f"the {len(maps)} maps stay in {apart} pieces: no loop joins them (are they of one store?)"
        )


def full_adjustment(map_: Map, rig: Rig, config: MapperConfig) -> None:
    """Bundle adjustment of everything as the mapper does it, the first keyframe held fast.

    Observations that disagree afterwards go, and with them the points that too few keyframes still see.
    """
    part = window.whole_map(map_, config)
    result = bundle_adjust(rig, part.bundle, window.bundle_config(config))
    window.write_back(map_, part, result)
    map_.cull_points(part.pt_rows[map_.points.obs_count[part.pt_rows] < config.min_observations])
    log.info("full bundle adjustment: cost %.1f to %.1f", result.initial_cost, result.cost)


def prune(saved: SavedMap, min_views: int = 0, min_seen_share: float = 0.0, unseen_sessions: int = 0) -> SavedMap:
    """Leave out points that are no longer there, then keyframes without points.

    Args:
        min_views: points seen by fewer keyframes go.
        min_seen_share: points that were seen in less than this share of the keyframes in whose view they lay go.
        unseen_sessions: points that no keyframe of the newest so many walks saw go.

    Raises:
        StereoSfmError: nothing would be left, or an argument out of its range.
    """
    if min_views < 0 or unseen_sessions < 0:
        raise StereoSfmError("--min-views and --unseen-sessions must be at least 0")
    if not 0 <= min_seen_share <= 1:
        raise StereoSfmError(f"--min-seen-share must be between 0 and 1, not {min_seen_share}")
    s = saved.snapshot
    views = np.bincount(s.obs_pt, minlength=len(s.pt_ids))
    keep = views >= min_views
    if min_seen_share > 0:
        keep &= s.seen >= min_seen_share * np.maximum(s.expected, 1)
    if unseen_sessions > 0:
        newest = np.full(len(s.pt_ids), -1)
        np.maximum.at(newest, s.obs_pt, saved.sessions[s.obs_kf])
        keep &= newest > saved.sessions.max() - unseen_sessions
    obs = keep[s.obs_pt]
    keyframes = np.bincount(s.obs_kf[obs], minlength=len(s.kf_ids)) > 0
    if not keep.any() or not keyframes.any():
        raise StereoSfmError("pruning so much would leave an empty map: ask for less")
    return dataclasses.replace(saved, snapshot=_subset(s, keyframes, keep, obs), sessions=saved.sessions[keyframes])


def _subset(s: MapSnapshot, keyframes: Bool, points: Bool, obs: Bool) -> MapSnapshot:
    """The rows that are kept (boolean masks); points of a keyframe that goes are carried by one that sees them."""
    kf_row, pt_row = np.cumsum(keyframes) - 1, np.cumsum(points) - 1
    obs_kf, obs_pt = kf_row[s.obs_kf[obs]], pt_row[s.obs_pt[obs]]
    corners = keyframes[s.corner_kf]
    anchors = np.where(keyframes[s.anchors[points]], kf_row[s.anchors[points]], _first_seer(obs_kf, obs_pt, points))
    return MapSnapshot(
        kf_ids=s.kf_ids[keyframes],
        frame_ids=s.frame_ids[keyframes],
        stamp_ns=s.stamp_ns[keyframes],
        submap_ids=s.submap_ids[keyframes],
        map_T_kf=s.map_T_kf[keyframes],
        pt_ids=s.pt_ids[points],
        points=s.points[points],
        anchors=anchors,
        seen=s.seen[points],
        expected=s.expected[points],
        obs_kf=obs_kf,
        obs_pt=obs_pt,
        uv_left=s.uv_left[obs],
        uv_right=s.uv_right[obs],
        descriptors=s.descriptors[obs],
        corner_kf=kf_row[s.corner_kf[corners]],
        corner_uv_left=s.corner_uv_left[corners],
        corner_uv_right=s.corner_uv_right[corners],
        corner_points=s.corner_points[corners],
        corner_descriptors=s.corner_descriptors[corners],
    )


def _first_seer(obs_kf: I64, obs_pt: I64, points: Bool) -> I64:
    """(P,) oldest keyframe that sees each kept point, 0 where none does."""
    first = np.full(int(points.sum()), np.iinfo(np.int64).max)
    np.minimum.at(first, obs_pt, obs_kf)
    return np.where(first == np.iinfo(np.int64).max, 0, first)
