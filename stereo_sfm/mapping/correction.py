"""Correction of the map for an accepted loop: keyframes move, points follow their anchors, matched points are fused.

The odometry stays: the caller derives `map_T_odom` from the newest keyframe, so that the map pose jumps and the
odometry pose does not.
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
from stereo_sfm.geometry.chi_squared import chi_squared
from stereo_sfm.mapping.level import weights
from stereo_sfm.mapping.map import Map
from stereo_sfm.mapping.pose_graph import Edges, Gravity, edges_of_poses, join, optimise
from stereo_sfm.mapping.side_points import join_corners
from stereo_sfm.tracking.flow.motion_prior import DRIFT
from stereo_sfm.types import F64, I64, LoopResult

# Shared points of keyframes that get an edge in the pose graph: as many as a loop must have.
COVISIBLE_POINTS = LoopConfig.min_inliers
# Standard deviation of an odometry edge, metres and radians per metre, of good tracking; DRIFT is its systematic part.
ODOMETRY = 0.004, 0.0006
MAX_STRAIN = 6.0  # sigmas^2 that a loop may keep: chi-squared of six degrees of freedom has this mean
MAX_NOISE = chi_squared(6, 0.95)  # sigmas^2: noise exceeds that in one of twenty loops
BRIDGE = 0.5, 0.1  # metres, radians, of what a session predicted over a gap in tracking
LOOP_SIGMAS = 0.01, 0.003  # metres, radians, smallest standard deviation of a loop: its points are not independent


@dataclass(frozen=True, eq=False)
class Correction:
    """The result of `apply_loop`."""

    applied: bool  # False: the pose graph rejected the loop, nothing moved
    fused: list[tuple[int, int]]  # point rows (removed, kept)
    bent: bool = False  # the map had contradicted the loop by more than the loop's noise explains


def apply_loop(
    map_: Map,
    loop: LoopResult,
    earlier: Sequence[LoopResult],
    config: LoopConfig,
    match_sigma_px: float = 1.0,
    bridges: tuple[I64, I64] | None = None,
) -> Correction:
    """Correct the map for an accepted loop.

    Args:
        map_: changed in place.
        earlier: loops applied before, which stay in the pose graph.
        match_sigma_px: noise of one coordinate of a fused point.
        bridges: rows (B,) and (B,) of keyframes that lie to each other about as they do, though nothing measured it.

    Returns:
        `applied` is False if the loop contradicts the rest of the graph; the map is then unchanged.
    """
    a, b = map_.kf_row(loop.candidate_kf_id), map_.kf_row(loop.kf_id)
    if not (map_.keyframes.alive[a] and map_.keyframes.alive[b]):
        return Correction(False, [])
    before = map_.keyframe_poses()
    odometry, closed = odometry_edges(map_, before), loop_edges(map_, [*earlier, loop])
    bent = _strain(before, closed) > MAX_NOISE
    measured = join([odometry, Edges(*(column[:-1] for column in vars(closed).values()))])
    part = _components(len(before), measured)
    apart, start = part[a] != part[b], before
    if apart:  # a submap that this loop connects with the rest: move the newer part there as a rigid body first
        move = before[a] @ loop.candidate_T_kf @ se3.inverse(before[b])
        newer, older, move = (b, a, move) if part[b] > part[a] else (a, b, se3.inverse(move))
        moving = part
        if bridges is not None:  # and with it what hangs on it alone
            free = (part[bridges[0]] != part[older]) & (part[bridges[1]] != part[older])
            weak = edges_of_poses(before, bridges[0][free], bridges[1][free], 0.0, 0.0)
            moving = _components(len(before), join([measured, weak]))
        start = np.where((moving == moving[newer])[:, None, None], move @ before, before)
    if bridges is not None:  # as they lie now: nothing measured them
        weak = edges_of_poses(start, *bridges, 0.0, 0.0)
        odometry = join([odometry, dataclasses.replace(weak, sigmas=np.tile(BRIDGE, (len(weak), 1)))])
    if config.correction == "averaging":
        after = start if apart else _averaged(map_, before, loop, a, b)
    elif config.correction == "pose_graph":
        optimised = _optimised(map_, start, odometry, closed, (a, b), config)
        if optimised is None:
            return Correction(False, [])
        after = optimised
    else:
        raise StereoSfmError(f"loop.correction is '{config.correction}': choose pose_graph or averaging")
    rows = map_.living_keyframes()
    map_.move_keyframes(rows, after[rows])
    map_.carry_points(before, after)
    return Correction(True, fuse_sides(map_, loop, match_sigma_px), bent)


def loop_is_known(map_: Map, loop: LoopResult) -> bool:
    """Whether the map already agrees with a loop within its noise, which a pose graph would make it follow."""
    return _strain(map_.keyframes.map_T_kf, loop_edges(map_, [loop])) <= MAX_STRAIN


def sides_share_points(map_: Map, loop: LoopResult, connected_points: int) -> bool:
    """Whether some keyframe that shares points with one end of a loop shares some with the other."""
    a, b = map_.kf_row(loop.candidate_kf_id), map_.kf_row(loop.kf_id)
    around_a, around_b = (map_.neighbours(row, connected_points) for row in (a, b))
    return len(np.intersect1d(np.append(around_a, a), around_b)) > 0


def fuse_sides(map_: Map, loop: LoopResult, match_sigma_px: float) -> list[tuple[int, int]]:
    """Make one of what both sides of a loop see: its pairs of living points, and its corners, which become points.

    Returns:
        Point rows (removed, kept): of pairs the first is kept.
    """
    fused: list[tuple[int, int]] = []
    for kept_id, removed_id in loop.matches.tolist():
        kept, removed = map_.point_rows(np.array([kept_id, removed_id]))
        if kept >= 0 and removed >= 0 and kept != removed and map_.points.alive[kept] and map_.points.alive[removed]:
            map_.fuse(int(removed), int(kept), match_sigma_px)
            fused.append((int(removed), int(kept)))
    return fused + join_corners(map_, loop.sightings, match_sigma_px)


def _averaged(map_: Map, before: F64, loop: LoopResult, a: int, b: int) -> F64:
    """The error of a loop from row a to b distributed over the path that led to it.

    Between two submaps that are connected already, the path of the newer one from its first keyframe takes the error.
    """
    if a > b:
        raise StereoSfmError("transformation averaging needs a loop back to an older keyframe")
    after, submap = before.copy(), map_.keyframes.submap_id
    rows = np.flatnonzero(submap == submap[b])
    first = int(np.searchsorted(rows, a)) if submap[a] == submap[b] else 0
    after[rows] = average_correction(
        before[rows], first, int(np.searchsorted(rows, b)), before[a] @ loop.candidate_T_kf
    )
    return after


def average_correction(poses: F64, first: int, last: int, corrected: F64) -> F64:
    """Transformation averaging (retail paper, section IV-C3): a loop's error, spread evenly over the keyframes.

    New poses (K, 4, 4) when keyframe row `last` must be at `corrected` (4, 4) and row `first` stays. Rows up to `first`
    keep their poses, rows after `last` move with it as a rigid body. Translation and rotation error are spread
    separately and linearly, as the paper does. It is exact only where the error grew evenly and the path is straight:
    turning a keyframe in place does not swing the ones after it.
    """
    out = poses.copy()
    count = last - first
    if count <= 0:
        return out
    shift = corrected[:3, 3] - poses[last, :3, 3]
    turn = se3.so3_log(corrected[:3, :3] @ poses[last, :3, :3].T)
    share = np.arange(1, count + 1) / count
    rows = np.arange(first + 1, last + 1)
    out[rows, :3, 3] += share[:, None] * shift
    out[rows, :3, :3] = se3.so3_exp(share[:, None] * turn) @ poses[rows, :3, :3]
    out[last + 1 :] = corrected @ se3.inverse(poses[last]) @ poses[last + 1 :]
    return out


def _optimised(
    map_: Map, start: F64, odometry: Edges, closed: Edges, ends: tuple[int, int], config: LoopConfig
) -> F64 | None:
    """Poses that agree with odometry and loops, or None if the last loop, between two rows, contradicts them.

    Odometry first has the accuracy of good tracking; if the loop is then strained, as much systematic drift is allowed
    as may accumulate along the path.
    """
    edges = join([odometry, closed])
    part, used = _components(len(start), edges), np.unique(np.concatenate([edges.i, edges.j]))
    fixed = used[np.unique(part[used], return_index=True)[1]]  # the oldest of each part
    gravity = _gravity(map_, start, used, part)
    result = optimise(start, edges, fixed, config.robust, gravity)
    strain = max(_strain(result.poses, closed), _tilt_strain(result.poses, gravity))
    if result.weights[-1] < 0.5 or strain > MAX_STRAIN:
        edges = join([_with_drift(odometry, closed, start, *ends), closed])
        result = optimise(start, edges, fixed, config.robust, gravity)
    if result.weights[-1] < 0.5:
        return None
    if gravity is None:
        return result.poses
    # Each part as a whole back to where its fixed row is: gravity may have tilted it.
    move = np.tile(np.eye(4), (int(part.max()) + 1, 1, 1))
    move[part[fixed]] = start[fixed] @ se3.inverse(result.poses[fixed])
    return move[part] @ result.poses


def _tilt_strain(poses: F64, gravity: Gravity | None) -> float:
    """Mean squared error of roll and pitch in sigmas, on the scale of `_strain`: noise alone gives 3, twice that 6."""
    if gravity is None:
        return 0.0
    off = np.cross(np.einsum("nij,nj->ni", poses[gravity.rows, :3, :3], gravity.seen), gravity.down)
    return 3.0 * float(np.mean((off**2).sum(axis=1) / gravity.sigma**2) / 2)


def _gravity(map_: Map, poses: F64, rows: I64, part: I64) -> Gravity | None:
    """What the living keyframes of some rows measured of gravity: for each part (K,) one direction, their mean."""
    table = map_.keyframes
    rows = rows[table.alive[rows] & (table.down_sigma[rows] > 0)]
    if not len(rows):
        return None
    seen, sigma, part = table.down[rows], table.down_sigma[rows], part[rows]
    total = np.zeros((int(part.max()) + 1, 3))
    np.add.at(total, part, np.einsum("nij,nj->ni", poses[rows, :3, :3], seen) * weights(sigma)[:, None])
    return Gravity(rows, seen, sigma, (total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None])[part])


def _strain(poses: F64, closed: Edges) -> float:
    """Squared error of the last loop in sigmas; its mean is 6 for noise alone."""
    error = se3.log(se3.inverse(closed.i_T_j[-1]) @ se3.inverse(poses[closed.i[-1]]) @ poses[closed.j[-1]])
    return float((error**2 / np.repeat(closed.sigmas[-1], 3) ** 2).sum())


def odometry_edges(map_: Map, poses: F64) -> Edges:
    """Edges between consecutive keyframes and between those that share many points (the covisibility graph)."""
    alive, doubt = map_.keyframes.alive, map_.keyframes.doubt
    pairs: set[tuple[int, int]] = set()
    for row in map_.living_keyframes().tolist():
        previous = int(map_.keyframes.previous[row])
        if previous >= 0 and alive[previous]:
            pairs.add((previous, row))
        for other in map_.neighbours(row, COVISIBLE_POINTS).tolist():
            if alive[other] and (doubt[other] == doubt[row]).all():  # else the points err as the odometry does
                pairs.add((min(row, other), max(row, other)))
    table = np.array(sorted(pairs), np.int64).reshape(-1, 2)
    edges = edges_of_poses(poses, table[:, 0], table[:, 1], *ODOMETRY)
    return dataclasses.replace(edges, sigmas=np.sqrt(edges.sigmas**2 + np.abs(doubt[edges.j] - doubt[edges.i])))


def _with_drift(odometry: Edges, closed: Edges, poses: F64, a: int, b: int) -> Edges:
    """The odometry edges with the uncertainty of systematic drift from row a to row b.

    An error of scale or heading is the same in all edges: it accumulates along the path instead of averaging out, and
    parallel edges are not independent. The variances of the edges along the path sum up to (DRIFT * path length)^2.
    Where odometry alone leads nowhere, as between two sessions, the path crosses the earlier ones of the loops.
    """
    length = np.linalg.norm(poses[odometry.j, :3, 3] - poses[odometry.i, :3, 3], axis=1)
    path = _shortest(length, odometry.i, odometry.j, a, b, len(poses))
    if not np.isfinite(path):
        i, j = (np.concatenate([getattr(odometry, n), getattr(closed, n)[:-1]]) for n in "ij")
        path = _shortest(np.append(length, np.zeros(len(closed) - 1)), i, j, a, b, len(poses))
    if not np.isfinite(path):
        return odometry
    parallel = len(odometry) / max(len(np.unique(odometry.j)), 1)
    drift = np.square(DRIFT) * (length * path)[:, None]
    return dataclasses.replace(odometry, sigmas=np.sqrt(parallel * (odometry.sigmas**2 + drift)))


def _shortest(length: F64, i: I64, j: I64, a: int, b: int, count: int) -> float:
    """Length of the shortest path from row a to row b of `count` over edges (E,), of parallel ones the shortest."""
    order = np.argsort(length, kind="stable")
    pairs = np.sort(np.stack([i[order], j[order]]), axis=0)
    (i, j), first = np.unique(pairs, axis=1, return_index=True)
    graph = scipy.sparse.coo_array((length[order][first] + 1e-9, (i, j)), shape=(count, count)).tocsr()
    return float(dijkstra(graph, directed=False, indices=a)[b])


def loop_edges(map_: Map, loops: Sequence[LoopResult]) -> Edges:
    """Edges of loops between living keyframes, in order; the last given loop is always among them."""
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
    """Standard deviations of a measured relative pose in metres and radians, at least LOOP_SIGMAS."""
    covariance = np.linalg.pinv(information)
    metres, radians = np.sqrt(np.trace(covariance[:3, :3]) / 3), np.sqrt(np.trace(covariance[3:, 3:]) / 3)
    return max(float(metres), LOOP_SIGMAS[0]), max(float(radians), LOOP_SIGMAS[1])


def _components(count: int, edges: Edges) -> I64:
    """(K,) connected component of each keyframe."""
    graph = scipy.sparse.coo_array((np.ones(len(edges)), (edges.i, edges.j)), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)
