"""What an accepted loop does to the map: keyframes move, points follow their anchors, paired points become one.

Nothing here touches the odometry: the caller derives `map_T_odom` from the newest keyframe, so that the map pose jumps
and the odometry pose does not.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components, dijkstra

from stereo_sfm.config import LoopConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.averaging import average_correction
from stereo_sfm.mapping.map import Map
from stereo_sfm.mapping.pose_graph import Edges, edges_of_poses, join, optimise
from stereo_sfm.types import F64, I64, LoopResult

STRONG = 30  # shared points that make an edge of the pose graph beside those of the walk
ODOMETRY = 0.004, 0.0006  # metres and radians per metre that an edge of the walk may be wrong by
RELAXED = 6.0  # squared sigmas that a loop may keep
DRIFT = 0.003, 0.0003  # metres and radians per metre that a walk as a whole may drift by: scale and heading
LOOP_SIGMAS = 0.01, 0.003  # metres, radians: at least this uncertain


@dataclass(frozen=True, eq=False)
class Correction:
    """What was done."""

    applied: bool  # False: the pose graph did not believe the loop, nothing moved
    fused: list[tuple[int, int]]  # point rows (gone, stays)


def apply_loop(
    map_: Map, loop: LoopResult, earlier: Sequence[LoopResult], config: LoopConfig, match_sigma_px: float = 1.0
) -> Correction:
    """Correct the map for an accepted loop.

    Args:
        map_: changed in place.
        earlier: loops applied before, which must keep holding.
        match_sigma_px: noise of one coordinate of a point that was fused.

    Returns:
        `applied` False when the loop contradicts the rest of the graph; the map is then as it was.
    """
    a, b = map_.kf_row(loop.candidate_kf_id), map_.kf_row(loop.kf_id)
    if not (map_.keyframes.alive[a] and map_.keyframes.alive[b]):
        return Correction(False, [])
    before = map_.keyframe_poses()
    if config.correction == "averaging":
        after = _averaged(map_, before, loop, earlier)
    elif config.correction == "pose_graph":
        optimised = _optimised(map_, before, loop, earlier, config)
        if optimised is None:
            return Correction(False, [])
        after = optimised
    else:
        raise StereoSfmError(f"loop.correction is '{config.correction}': choose pose_graph or averaging")
    rows = map_.living_keyframes()
    map_.move_keyframes(rows, after[rows])
    map_.carry_points(before, after)
    return Correction(True, fuse_pairs(map_, loop.matches, match_sigma_px))


def loop_is_known(map_: Map, loop: LoopResult, connected_points: int) -> bool:
    """Whether the map says already what a loop says: its two sides share points, and stand as the loop has them."""
    a, b = map_.kf_row(loop.candidate_kf_id), map_.kf_row(loop.kf_id)
    beside_a, beside_b = (map_.neighbours(row, connected_points)[0] for row in (a, b))
    if not len(np.intersect1d(np.append(beside_a, a), beside_b)):
        return False
    poses = map_.keyframes.map_T_kf
    error = se3.log(se3.inverse(loop.candidate_T_kf) @ se3.inverse(poses[a]) @ poses[b])
    metres, radians = loop_sigmas(loop.information)
    return bool(np.linalg.norm(error[:3]) < metres and np.linalg.norm(error[3:]) < radians)


def fuse_pairs(map_: Map, pairs: I64, match_sigma_px: float) -> list[tuple[int, int]]:
    """Make one point of each pair of ids (M, 2) that are two living points; the first of a pair stays.

    Returns:
        Rows (gone, stays).
    """
    fused: list[tuple[int, int]] = []
    for keep, drop in pairs.tolist():
        new, old = map_.point_rows(np.array([keep, drop]))
        if new >= 0 and old >= 0 and new != old and map_.points.alive[new] and map_.points.alive[old]:
            map_.fuse(int(old), int(new), match_sigma_px)
            fused.append((int(old), int(new)))
    return fused


def _averaged(map_: Map, before: F64, loop: LoopResult, earlier: Sequence[LoopResult]) -> F64:
    """The error spread over the walk that led to the loop. Pieces that the loop joins move as rigid bodies only.

    Between two walks (submaps) that hang together already, the younger one's way from its first keyframe takes it.
    """
    a, b = map_.kf_row(loop.candidate_kf_id), map_.kf_row(loop.kf_id)
    walk, closed = walk_edges(map_, before), loop_edges(map_, [*earlier, loop])
    piece = _pieces(len(before), walk, closed, len(closed) - 1)
    if piece[a] != piece[b]:
        return _brought_together(before, loop, a, b, piece)
    if a > b:
        raise StereoSfmError("transformation averaging needs a loop back to an older keyframe")
    after, submap = before.copy(), map_.keyframes.submap_id
    rows = np.flatnonzero(submap == submap[b])
    first = int(np.searchsorted(rows, a)) if submap[a] == submap[b] else 0
    after[rows] = average_correction(
        before[rows], first, int(np.searchsorted(rows, b)), before[a] @ loop.candidate_T_kf
    )
    return after


def _brought_together(before: F64, loop: LoopResult, a: int, b: int, piece: I64) -> F64:
    """The younger of two pieces moved to where the loop has it."""
    after = before.copy()
    move = before[a] @ loop.candidate_T_kf @ se3.inverse(before[b])
    rows = piece == piece[b] if piece[b] > piece[a] else piece == piece[a]
    after[rows] = (move if piece[b] > piece[a] else se3.inverse(move)) @ before[rows]
    return after


def _optimised(
    map_: Map, before: F64, loop: LoopResult, earlier: Sequence[LoopResult], config: LoopConfig
) -> F64 | None:
    """Poses that agree with the walk and the loops, or None where they contradict each other.

    The walk counts as exact as a good tracker makes it; where the loop then stays strained, as much drift is allowed as
    may add up along the way.
    """
    a, b = map_.kf_row(loop.candidate_kf_id), map_.kf_row(loop.kf_id)
    walk = walk_edges(map_, before)
    closed = loop_edges(map_, [*earlier, loop])
    piece = _pieces(len(before), walk, closed, len(closed) - 1)
    start = before
    if piece[a] != piece[b]:  # a submap that this loop joins to the rest: bring it there as a rigid body first
        start = _brought_together(before, loop, a, b, piece)
    fixed = _first_of_each_piece(len(before), join([walk, closed]))
    result = optimise(start, join([walk, closed]), fixed, config.robust)
    if result.weights[-1] < 0.5 or _strain(result.poses, closed) > RELAXED:
        result = optimise(start, join([_loosened(walk, before, a, b), closed]), fixed, config.robust)
    return result.poses if result.weights[-1] >= 0.5 else None


def _strain(poses: F64, closed: Edges) -> float:
    """Squared error in sigmas that the last loop keeps; 6 is what noise alone leaves."""
    error = se3.log(se3.inverse(closed.i_T_j[-1]) @ se3.inverse(poses[closed.i[-1]]) @ poses[closed.j[-1]])
    return float((error**2 / np.repeat(closed.sigmas[-1], 3) ** 2).sum())


def walk_edges(map_: Map, poses: F64) -> Edges:
    """Edges between keyframes that follow each other and those that share many points (the covisibility graph)."""
    alive = map_.keyframes.alive
    pairs: set[tuple[int, int]] = set()
    for row in map_.living_keyframes().tolist():
        previous = int(map_.keyframes.previous[row])
        if previous >= 0 and alive[previous]:
            pairs.add((previous, row))
        for other in map_.neighbours(row, STRONG)[0].tolist():
            if alive[other]:
                pairs.add((min(row, other), max(row, other)))
    table = np.array(sorted(pairs), np.int64).reshape(-1, 2)
    return edges_of_poses(poses, table[:, 0], table[:, 1], *ODOMETRY)


def _loosened(walk: Edges, poses: F64, a: int, b: int) -> Edges:
    """The edges of the walk as uncertain as drift from row a to row b makes them.

    A wrong scale or a turning heading is alike in all edges. Their errors add up along the way instead of averaging
    out, and edges beside each other know nothing that one alone does not. The sum of the variances of the edges of
    DRIFT along the way is (DRIFT * way)^2.
    """
    length = np.linalg.norm(poses[walk.j, :3, 3] - poses[walk.i, :3, 3], axis=1)
    graph = scipy.sparse.coo_array((length + 1e-9, (walk.i, walk.j)), shape=(len(poses), len(poses))).tocsr()
    way = float(dijkstra(graph, directed=False, indices=a)[b])
    if not np.isfinite(way):
        return walk
    beside = len(walk) / max(len(np.unique(walk.j)), 1)
    drift = np.square(DRIFT) * (length * way)[:, None]
    return dataclasses.replace(walk, sigmas=np.sqrt(beside * (walk.sigmas**2 + drift)))


def loop_edges(map_: Map, loops: Sequence[LoopResult]) -> Edges:
    """Edges of loops whose keyframes still live, in order; the last loop given is always among them."""
    alive = map_.keyframes.alive
    rows = [(map_.kf_row(x.candidate_kf_id), map_.kf_row(x.kf_id)) for x in loops]
    kept = [k for k, (i, j) in enumerate(rows) if alive[i] and alive[j]]
    sigmas = [loop_sigmas(loops[k].information) for k in kept]
    return Edges(
        np.array([rows[k][0] for k in kept], np.int64),
        np.array([rows[k][1] for k in kept], np.int64),
        np.array([loops[k].candidate_T_kf for k in kept]).reshape(-1, 4, 4),
        np.array(sigmas).reshape(-1, 2),
        np.ones(len(kept), bool),
    )


def loop_sigmas(information: F64) -> tuple[float, float]:
    """Metres and radians of a measured relative pose, never more certain than LOOP_SIGMAS."""
    covariance = np.linalg.pinv(information)
    metres, radians = np.sqrt(np.trace(covariance[:3, :3]) / 3), np.sqrt(np.trace(covariance[3:, 3:]) / 3)
    return max(float(metres), LOOP_SIGMAS[0]), max(float(radians), LOOP_SIGMAS[1])


def _pieces(count: int, walk: Edges, closed: Edges, without: int) -> I64:
    """(K,) which connected piece a keyframe is in when the loop edge `without` is left out."""
    i = np.concatenate([walk.i, np.delete(closed.i, without)])
    j = np.concatenate([walk.j, np.delete(closed.j, without)])
    return _components(count, i, j)


def _components(count: int, i: I64, j: I64) -> I64:
    graph = scipy.sparse.coo_array((np.ones(len(i)), (i, j)), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _first_of_each_piece(count: int, edges: Edges) -> I64:
    """Rows that hold the pieces of the graph in place: the oldest of each."""
    piece = _components(count, edges.i, edges.j)
    used = np.unique(np.concatenate([edges.i, edges.j]))
    return used[np.unique(piece[used], return_index=True)[1]]
