"""A session put into the map of a store, whose size stays bounded by the store however often it is driven.

The session's keyframes look for loops in the map, which is rigid until then; both are adjusted together, in the frame
of the map. A keyframe is forgotten when enough later sessions have had its view, and with it the points that none of
them saw: products that were exchanged, shelves that are gone. So each view keeps its newest visits.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from stereo_sfm.config import LoopConfig, MapperConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.loop.vocabulary import Vocabulary
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.maps.joining import join
from stereo_sfm.maps.merge import share_a_session, subset
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.types import F64, I64, Bool, LoopResult

KEPT_SESSIONS = 3  # later ones that saw a keyframe's view before it is forgotten: one may have seen a trolley there
VIEW_DEPTHS = 0.25  # of the median depth of a keyframe: distance of a camera with the same view
VIEW_METRES = 0.4, 1.5  # bounds of that distance
VIEW_DEG = 25.0  # degrees, of the same


@dataclass(frozen=True, eq=False)
class Update:
    """The new map and what became of the session."""

    saved: SavedMap
    session: int  # its number in the map
    loops: list[LoopResult]  # from the session to the map or within the session, in ids before renumbering
    fused: int  # points of the session that the map had
    forgotten: int  # keyframes
    together: MapSnapshot  # map and session before anything was forgotten, in the frame of the map
    together_sessions: I64  # (K,) of its keyframes


def update(
    saved: SavedMap,
    walk: SavedMap,
    vocabulary: Vocabulary,
    config: LoopConfig,
    mapper: MapperConfig,
    place: LoopResult | None = None,
) -> Update:
    """Put a session into a map; the map's frame stays where it is.

    Args:
        saved: the map. walk: the session's own map.
        vocabulary: of the loop search. config: of the loops. mapper: of the bundle adjustment at the end.
        place: a known loop from the map to the session, in the ids of each.

    Raises:
        StereoSfmError: one camera and two, a session that is in the map already, or that no loop joins to it.
    """
    if place is None and share_a_session(saved, walk):  # with a place it was driven just now
        raise StereoSfmError("this session is in the map already")
    both, joining = join([saved, walk], vocabulary, config, mapper, place, rigid=True)
    boundary = int(both.snapshot.kf_ids[len(saved)])
    if not any(loop.candidate_kf_id < boundary <= loop.kf_id for loop in joining.loops):
        raise StereoSfmError("the session was not found in the map: no loop joins them (are they of one store?)")
    together, sessions = joining.content()
    rest, _ = without_superseded(together, sessions)
    forgotten = len(together.kf_ids) - len(rest.kf_ids)
    if forgotten:
        joining.begin(rest)
    joining.adjust()
    snapshot, kept_sessions = joining.content()
    new = SavedMap(in_frame_of(saved.snapshot, snapshot), both.cameras, vocabulary.id, kept_sessions)
    number = int(both.sessions[len(saved)])
    return Update(new, number, joining.loops, joining.fused, forgotten, together, sessions)


def without_superseded(together: MapSnapshot, sessions: I64) -> tuple[MapSnapshot, I64]:
    """The map without keyframes whose view enough later sessions have had, and the session of each of the others."""
    kept = ~_superseded(together, sessions)
    if kept.all():
        return together, sessions
    obs = kept[together.obs_kf]
    points = np.bincount(together.obs_pt[obs], minlength=len(together.pt_ids)) > 0
    return subset(together, kept, points, obs), sessions[kept]


def in_frame_of(before: MapSnapshot, after: MapSnapshot) -> MapSnapshot:
    """A map that goes on from another one: in its frame; ids from 0 on do not grow with the number of sessions."""
    move = _back(before, after)
    return dataclasses.replace(
        after,
        map_T_kf=se3.orthonormalize(move @ after.map_T_kf),
        points=se3.transform(move, after.points),
        kf_ids=np.arange(len(after.kf_ids), dtype=np.int64),
        pt_ids=np.arange(len(after.pt_ids), dtype=np.int64),
        submap_ids=np.unique(after.submap_ids, return_inverse=True)[1].astype(np.int64),
    )


def _superseded(s: MapSnapshot, sessions: I64) -> Bool:
    """(K,) which keyframes have a view that at least KEPT_SESSIONS later sessions have had."""
    centres = s.map_T_kf[:, :3, 3]
    depth = np.linalg.norm(s.points[s.obs_pt] - centres[s.obs_kf], axis=1)
    order = np.lexsort((depth, s.obs_kf))
    count = np.bincount(s.obs_kf, minlength=len(s.kf_ids))
    middle = np.minimum(np.cumsum(count) - count + count // 2, max(len(order) - 1, 0))
    radius = np.clip(VIEW_DEPTHS * np.where(count > 0, depth[order[middle]], 0.0), *VIEW_METRES)
    around = KDTree(centres).query_ball_point(centres, radius, return_sorted=True)
    out = np.zeros(len(s.kf_ids), bool)
    for row, near in enumerate(around):
        later = np.array([k for k in near if sessions[k] > sessions[row]], np.int64)
        if len(later):
            turned = se3.extent(se3.inverse(s.map_T_kf[later]) @ s.map_T_kf[row])[1]
            visits = np.unique(sessions[later[turned < np.deg2rad(VIEW_DEG)]])
            out[row] = len(visits) >= KEPT_SESSIONS
    return out


def _back(before: MapSnapshot, after: MapSnapshot) -> F64:
    """before_T_after (4, 4) that lays the keyframes of both on each other, so that the map's frame does not wander."""
    _, i, j = np.intersect1d(before.kf_ids, after.kf_ids, return_indices=True)
    if not len(i):
        return np.eye(4)
    each = before.map_T_kf[i] @ se3.inverse(after.map_T_kf[j])
    u, _, vt = np.linalg.svd(each[:, :3, :3].mean(0))
    rotation = u @ vt
    shift = (before.map_T_kf[i, :3, 3] - after.map_T_kf[j, :3, 3] @ rotation.T).mean(0)
    return se3.from_rotation_translation(rotation, shift)
