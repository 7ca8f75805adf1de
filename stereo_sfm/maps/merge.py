"""Merging maps of several sessions in one store: loops between them, one pose graph, full bundle adjustment."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import LoopConfig, MapperConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.loop.closer import LoopCloser
from stereo_sfm.loop.other_camera import widest
from stereo_sfm.loop.vocabulary import Vocabulary
from stereo_sfm.mapping import window
from stereo_sfm.mapping.bundle import BundleResult, bundle_adjust
from stereo_sfm.mapping.correction import apply_loop, fuse_sides, loop_is_known
from stereo_sfm.mapping.map import Map, MapSnapshot
from stereo_sfm.maps.saved_map import SavedMap, joined, restore_map
from stereo_sfm.types import I64, Bool, LoopResult

_MAPPER = MapperConfig()
log = logging.getLogger("stereo_sfm")
MIN_SHARED_PIXELS = 0.5  # of the pixels at common times, in maps of one session; different images share hardly any
MERGE_PAUSE = 2  # keyframes between two loops of a merge: every link between the sessions helps


@dataclass(frozen=True, eq=False)
class Merge:
    """The merged map and statistics of the merge."""

    saved: SavedMap
    loops: list[LoopResult]  # accepted, in ids of the merged map
    fused: int  # points fused with another one


def merge(
    maps: Sequence[SavedMap],
    vocabulary: Vocabulary,
    config: LoopConfig,
    mapper: MapperConfig = _MAPPER,
    place: LoopResult | None = None,
) -> Merge:
    """Merge maps into one; the first keeps its frame.

    Args:
        maps: two or more.
        vocabulary: of the loop search. Maps store descriptors, so it need not be the one they were built with.
        config: of the loops.
        mapper: of the bundle adjustment at the end.
        place: a known loop from the first map to the second, in the ids of each.

    Raises:
        StereoSfmError: maps of one and of two cameras, or a map that no loop joins to the others.
    """
    side_by_side = joined(list(maps))
    map_ = restore_for_merging(side_by_side.snapshot, mapper)
    rigs = side_by_side.keyframe_rigs()
    closer = session_closer(config, rigs, vocabulary)
    sessions, stamps = side_by_side.sessions, side_by_side.snapshot.stamp_ns
    begins = {k: int(stamps[sessions == k].min()) for k in side_by_side.session_ids}  # sessions have unrelated clocks
    loops: list[LoopResult] = []
    fused = 0
    if place is not None:
        fused += close_loop(map_, in_joined_ids(place, maps[0]), loops, config, mapper)
    others_begin = int(_ends(maps, "kf_ids")[0])
    for keyframe, k, rig in zip(side_by_side.snapshot.keyframes(), sessions.tolist(), rigs, strict=True):
        keyframe = dataclasses.replace(keyframe, stamp_ns=keyframe.stamp_ns - begins[k])
        if keyframe.kf_id < others_begin:  # its own loops are in the map
            closer.add(keyframe, rig)
            continue
        result = closer.step(keyframe, rig)
        if result.candidate_kf_id >= 0:
            fused += close_loop(map_, result, loops, config, mapper)
    _check_joined(maps, loops)
    full_adjustment(map_, dict(zip(side_by_side.snapshot.kf_ids.tolist(), rigs, strict=True)), mapper)
    snapshot = map_.snapshot()
    session_of = dict(zip(side_by_side.snapshot.kf_ids.tolist(), sessions.tolist(), strict=True))
    merged = np.array([session_of[k] for k in snapshot.kf_ids.tolist()], np.int64)
    return Merge(SavedMap(snapshot, side_by_side.cameras, vocabulary.id, merged), loops, fused)


def close_loop(map_: Map, loop: LoopResult, loops: list[LoopResult], config: LoopConfig, mapper: MapperConfig) -> int:
    """Join what both sides of a loop see, after a correction of the map unless it agrees with the loop.

    Args:
        loops: those before; this one is appended unless the pose graph rejects it.

    Returns:
        How many points were fused with another one.
    """
    if loop_is_known(map_, loop):
        loops.append(loop)
        return len(fuse_sides(map_, loop, mapper.match_sigma_px))
    done = apply_loop(map_, loop, loops, config, mapper.match_sigma_px)
    if done.applied:
        loops.append(loop)
    return len(done.fused)


def in_joined_ids(place: LoopResult, first: SavedMap) -> LoopResult:
    """A loop from the first of two maps to the second, in the ids of each, in the numbering of `joined`."""
    raised = np.array([0, _ends([first], "pt_ids")[0]])
    kf_id = place.kf_id + int(_ends([first], "kf_ids")[0])
    return dataclasses.replace(place, kf_id=kf_id, matches=place.matches + raised)


def restore_for_merging(snapshot: MapSnapshot, mapper: MapperConfig) -> Map:
    """A map whose points all have the noise of tracked ones: those fused from now on count less."""
    map_ = restore_map(snapshot)
    map_.points.sigma[:] = map_.observations.sigma[:] = mapper.sigma_px
    return map_


def session_closer(config: LoopConfig, rigs: Sequence[Rig], vocabulary: Vocabulary) -> LoopCloser:
    """A loop closer that looks for every link between sessions, of keyframes that these rigs took; the last the newest.

    Places are compared as the rig with the widest view sees them.
    """
    return LoopCloser(dataclasses.replace(config, pause=MERGE_PAUSE), widest(rigs[::-1]), vocabulary)


def share_a_session(a: SavedMap, b: SavedMap) -> bool:
    """Whether two maps have a session in common: the same pixels observed at the same times.

    Stamps alone are not enough, they begin at zero in many recordings.
    """
    return any(_same_session(_sightings(a, m), _sightings(b, n)) for m in a.session_ids for n in b.session_ids)


def _sightings(saved: SavedMap, session: int) -> dict[int, set[tuple[float, float]]]:
    """The observed pixels of the left camera in a session (float32 as in files), by the keyframe's stamp."""
    s = saved.snapshot
    rows = np.flatnonzero((saved.sessions == session)[s.obs_kf])
    out: dict[int, set[tuple[float, float]]] = {}
    for stamp, (u, v) in zip(s.stamp_ns[s.obs_kf[rows]].tolist(), s.uv_left[rows].astype(np.float32), strict=True):
        out.setdefault(stamp, set()).add((float(u), float(v)))
    return out


def _same_session(a: dict[int, set[tuple[float, float]]], b: dict[int, set[tuple[float, float]]]) -> bool:
    times = a.keys() & b.keys()
    same = sum(len(a[t] & b[t]) for t in times)
    return same > MIN_SHARED_PIXELS * sum(min(len(a[t]), len(b[t])) for t in times)


def _ends(maps: Sequence[SavedMap], ids: str) -> I64:
    """(maps,) first free id after each map in the numbering of `joined`."""
    return np.cumsum([int(getattr(saved.snapshot, ids).max()) + 1 for saved in maps])


def _check_joined(maps: Sequence[SavedMap], loops: list[LoopResult]) -> None:
    """Raises StereoSfmError unless loops connect every map to the first one."""
    ends = _ends(maps, "kf_ids")
    group = np.arange(len(maps))
    for loop in loops:
        a, b = group[np.searchsorted(ends, [loop.candidate_kf_id, loop.kf_id], side="right")]
        group[group == max(a, b)] = min(a, b)
    groups = len(np.unique(group))
    if groups > 1:
        raise StereoSfmError(
            f"the {len(maps)} maps remain {groups} separate maps: no loop joins them (are they of one store?)"
        )


def full_adjustment(map_: Map, rigs: Mapping[int, Rig], config: MapperConfig) -> None:
    """Bundle adjustment of the whole map with the mapper's settings, the first keyframe fixed.

    Args: rigs, by the ids of the keyframes that they took.
    """
    result = adjust(map_, window.whole_map(map_), rigs, config)
    log.info("full bundle adjustment: cost %.1f to %.1f", result.initial_cost, result.cost)


def adjust(map_: Map, part: window.Window, rigs: Mapping[int, Rig], config: MapperConfig) -> BundleResult:
    """Bundle adjustment of a part of the map with the mapper's settings.

    Outlier observations are removed afterwards, and points that too few keyframes still observe.

    Args: rigs, by the ids of the keyframes that they took.
    """
    taken = [rigs[k] for k in map_.keyframes.kf_id[part.kf_rows].tolist()]
    number = {rig: i for i, rig in enumerate(dict.fromkeys(taken))}
    which = np.array([number[rig] for rig in taken], np.int64) if len(number) > 1 else None
    bundle = dataclasses.replace(part.bundle, kf_rig=which)
    result = bundle_adjust(list(number), bundle, window.bundle_config(config))
    window.write_back(map_, part, result)
    map_.cull_points(part.pt_rows[map_.points.obs_count[part.pt_rows] < 2])
    return result


def prune(saved: SavedMap, min_views: int = 0, min_seen_share: float = 0.0, unseen_sessions: int = 0) -> SavedMap:
    """Remove outdated points, then keyframes without points.

    Args:
        min_views: remove points observed by fewer keyframes.
        min_seen_share: remove points observed in a smaller share of the keyframes in whose view they lie.
        unseen_sessions: remove points not observed in this many of the newest sessions.

    Raises:
        StereoSfmError: the map would become empty, or an argument is out of range.
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
        raise StereoSfmError("pruning would leave an empty map: use lower limits")
    return dataclasses.replace(saved, snapshot=subset(s, keyframes, keep, obs), sessions=saved.sessions[keyframes])


def subset(s: MapSnapshot, keyframes: Bool, points: Bool, obs: Bool) -> MapSnapshot:
    """The rows selected by boolean masks; points anchored in a removed keyframe get another one that observes them."""
    kf_row, pt_row = np.cumsum(keyframes) - 1, np.cumsum(points) - 1
    obs_kf, obs_pt = kf_row[s.obs_kf[obs]], pt_row[s.obs_pt[obs]]
    corners = keyframes[s.corner_kf]
    anchors = np.where(keyframes[s.anchors[points]], kf_row[s.anchors[points]], _first_observer(obs_kf, obs_pt, points))
    return MapSnapshot(
        kf_ids=s.kf_ids[keyframes],
        frame_ids=s.frame_ids[keyframes],
        stamp_ns=s.stamp_ns[keyframes],
        submap_ids=s.submap_ids[keyframes],
        map_T_kf=s.map_T_kf[keyframes],
        down=s.down[keyframes],
        down_sigma=s.down_sigma[keyframes],
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
        corner_side=s.corner_side[corners],
    )


def _first_observer(obs_kf: I64, obs_pt: I64, points: Bool) -> I64:
    """(P,) oldest keyframe that observes each kept point, 0 if none."""
    first = np.full(int(points.sum()), np.iinfo(np.int64).max)
    np.minimum.at(first, obs_pt, obs_kf)
    return np.where(first == np.iinfo(np.int64).max, 0, first)
