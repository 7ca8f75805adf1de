"""Culling of weak points and redundant keyframes."""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.mapping import map_kernels
from stereo_sfm.mapping.map import Map
from stereo_sfm.types import F64, I64, Bool

OTHERS = 3  # keyframes that observe a point, beyond which one more is redundant (ORB-SLAM, TRO 31, 2015, section VI-E)
# Keyframes that stay of those that see the same, in the map and among the loop closer's candidates: they bound memory
# and time where the robot does not leave a place.
OF_A_VIEW, OF_EARLIER_VISITS = 5, 300  # of one view; besides, of all views that earlier visits had
PASSED = 30  # newest keyframes, which are not counted yet: the camera may still be there
# Keyframes of the same view: distance in median depths, angle. Most of what one sees, the other sees.
SAME_VIEW_DEPTHS, SAME_VIEW_DEG = 0.15, 15.0


def weak_points(map_: Map, rig: Rig, rows: I64, newest: int, config: MapperConfig) -> I64:
    """The rows of points to cull.

    A point that the newest keyframe sees is kept unless its observations disagree: a far point without parallax still
    determines the rotation of the camera. One that is no longer tracked needs enough observations and enough parallax.
    """
    points = map_.points
    rows = rows[points.alive[rows]]
    lost = points.last_seen[rows] < newest
    few = lost & (points.obs_count[rows] < 2)
    table, pose, judged = map_.observations, map_.keyframes.map_T_kf, np.empty((len(rows), 2))
    map_kernels.judge_points(
        rows, points.head, table.following, table.kf, table.uv_left, table.uv_right, table.sigma,
        pose[:, :3, :3], pose[:, :3, 3], points.xyz, rig.left.model_id, rig.left.params, rig.baseline, judged,
    )  # fmt: skip
    error, parallax = judged.T
    bad = (error > config.max_error_sigmas) & (points.obs_count[rows] >= 2)
    narrow = lost & (parallax < np.deg2rad(config.min_parallax_deg))
    unseen = points.obs_count[rows] == 0
    return rows[few | bad | narrow | unseen]


def redundant_keyframe(map_: Map, newest: int, protected: Bool, earlier: I64, config: MapperConfig) -> int:
    """A redundant neighbour of the newest keyframe, -1: none.

    The oldest one whose points are seen well enough by others; else, in a place that the robot visits often, the one
    of several with the same view whose points are seen best by others: a view keeps OF_A_VIEW keyframes. Of each view
    one by which places are recognised stays.

    Args:
        protected: (K,) keyframes that must stay (the first and the newest ones). earlier: see `earlier_visits`.
    """
    if config.redundant_share > 1:
        return -1
    neighbours = map_.neighbours(newest, config.connected_points)
    neighbours = np.sort(neighbours[~protected[neighbours]])
    shares = _seen_by_others(map_, neighbours)
    for row in neighbours[shares > config.redundant_share].tolist():
        if not _alone_described(map_, row, config):
            return row
    same = np.union1d(neighbours[_same_view(map_, newest, neighbours)], earlier)
    if len(same) <= OF_A_VIEW:
        return -1
    plain = same[~_described(map_, same)]
    same = plain if len(plain) else same
    return int(same[np.argmax(_seen_by_others(map_, same))])


def _described(map_: Map, rows: I64) -> Bool:
    """(N,) which keyframes have corners for place recognition: about one of two in an aisle."""
    return np.array([len(map_.corners[row][0]) > 0 for row in rows.tolist()], bool)


def _alone_described(map_: Map, row: int, config: MapperConfig) -> bool:
    """Whether a camera might not be found in a keyframe's view without it: it has corners, and no older one there has.

    Were a newer one enough, that would go for one that is newer still, and so on to the end of an aisle.
    """
    if not len(map_.corners[row][0]):
        return False
    others = map_.neighbours(row, config.connected_points)
    others = others[others < row]
    return not _described(map_, others[_same_view(map_, row, others)]).any()


def earlier_visits(map_: Map, newest: int, protected: Bool) -> I64:
    """Keyframes of the newest one's view from before the camera last came there, also if they share no point with it.

    A visit does not recognise all points of the earlier ones. Without these keyframes a view would keep ever more.
    """
    living, submap = map_.living_keyframes(), map_.keyframes.submap_id
    living = living[submap[living] == submap[newest]]
    same = _same_view(map_, newest, living)
    elsewhere = np.flatnonzero(~same)
    if not len(elsewhere):
        return np.zeros(0, np.int64)
    earlier = living[: elsewhere[-1]][same[: elsewhere[-1]]]
    return earlier[~protected[earlier]]


def loose_keyframes(map_: Map, old_enough: Bool, repeated: I64, config: MapperConfig) -> I64:
    """Keyframes that have lost so many points that hardly anything holds them: adjusted, they would go anywhere.

    Fewer than make two keyframes neighbours; twice as many of those in `repeated`, whose views others have as well.

    Args:
        old_enough: (K,) keyframes that may go. The first of a submap stays.
    """
    keyframes, table = map_.keyframes, map_.observations
    seen = np.flatnonzero(table.pt >= 0)
    shared = seen[map_.points.obs_count[table.pt[seen]] > 1]
    least = np.full(len(keyframes), config.connected_points)
    least[repeated] *= 2
    few = np.bincount(table.kf[shared], minlength=len(keyframes)) < least
    return np.flatnonzero(keyframes.alive & old_enough & few & (keyframes.previous >= 0))


def _seen_by_others(map_: Map, rows: I64) -> F64:
    """(N,) share of each keyframe's points that enough other keyframes see."""
    counts = [map_.points.obs_count[map_.seen_by(row)] for row in rows.tolist()]
    return np.array([np.count_nonzero(seen > OTHERS) / max(len(seen), 1) for seen in counts])


def _same_view(map_: Map, newest: int, rows: I64) -> Bool:
    """(N,) which keyframes have about the pose of the newest."""
    poses = map_.keyframes.map_T_kf
    pts = map_.seen_by(newest)
    depth = np.nanmedian(np.linalg.norm(map_.points.xyz[pts] - poses[newest, :3, 3], axis=1)) if len(pts) else 0.0
    metres, radians = se3.extent(se3.inverse(poses[rows]) @ poses[newest])
    return (metres < SAME_VIEW_DEPTHS * depth) & (radians < np.deg2rad(SAME_VIEW_DEG))
