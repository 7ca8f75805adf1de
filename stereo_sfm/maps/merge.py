"""Merging maps of several sessions in one store: loops between them, one pose graph, full bundle adjustment."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereo_sfm.config import LoopConfig, MapperConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.loop.vocabulary import Vocabulary
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.maps.columns import COLUMNS
from stereo_sfm.maps.joining import ends, join
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.types import I64, Bool, LoopResult

_MAPPER = MapperConfig()


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
    side_by_side, joining = join(maps, vocabulary, config, mapper, place)
    _check_joined(maps, joining.loops)
    joining.adjust()
    snapshot, sessions = joining.content()
    return Merge(SavedMap(snapshot, side_by_side.cameras, vocabulary.id, sessions), joining.loops, joining.fused)


def share_a_session(a: SavedMap, b: SavedMap) -> bool:
    """Whether two maps have a session in common: the same pixels observed at the same times.

    Stamps alone are not enough, they begin at zero in many recordings.
    """
    return any(_same_session(_sightings(a, m), _sightings(b, n)) for m in a.session_ids for n in b.session_ids)


def _sightings(saved: SavedMap, session: int) -> I64:
    """(M, 2) of a session: the keyframe's stamp and the bits of a pixel of the left camera (float32 as in files)."""
    s = saved.snapshot
    rows = np.flatnonzero((saved.sessions == session)[s.obs_kf])
    pixels = np.ascontiguousarray(s.uv_left[rows], np.float32).view(np.int64)
    return np.unique(np.column_stack([s.stamp_ns[s.obs_kf[rows]], pixels]), axis=0)


def _same_session(a: I64, b: I64) -> bool:
    times = np.intersect1d(a[:, 0], b[:, 0])
    a, b = (part[np.isin(part[:, 0], times)] for part in (a, b))
    same = len(a) + len(b) - len(np.unique(np.concatenate([a, b]), axis=0))
    counts = [np.unique(part[:, 0], return_counts=True)[1] for part in (a, b)]
    return bool(2 * same > np.minimum(*counts).sum())  # different images share hardly any


def _check_joined(maps: Sequence[SavedMap], loops: list[LoopResult]) -> None:
    """Raises StereoSfmError unless loops connect every map to the first one."""
    last = ends(maps, "kf_ids")
    group = np.arange(len(maps))
    for loop in loops:
        a, b = group[np.searchsorted(last, [loop.candidate_kf_id, loop.kf_id], side="right")]
        group[group == max(a, b)] = min(a, b)
    groups = len(np.unique(group))
    if groups > 1:
        raise StereoSfmError(
            f"the {len(maps)} maps remain {groups} separate maps: no loop joins them (are they of one store?)"
        )


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
    """The rows selected by boolean masks; points anchored in a removed keyframe get the oldest that observes them."""
    kept = {"keyframes": keyframes, "points": points, "observations": obs, "corners": keyframes[s.corner_kf]}
    row = {"keyframes": np.cumsum(keyframes) - 1, "points": np.cumsum(points) - 1}
    out: dict[str, Any] = {}
    for name, column in COLUMNS.items():
        if name != "sessions":
            values = getattr(s, name)[kept[column.table]]
            out[name] = row[column.index][values] if column.index else values
    gone, none = ~keyframes[s.anchors[points]], np.iinfo(np.int64).max
    first = np.full(int(points.sum()), none)
    np.minimum.at(first, out["obs_pt"], out["obs_kf"])
    out["anchors"][gone] = np.where(first == none, 0, first)[gone]
    return MapSnapshot(**out)
