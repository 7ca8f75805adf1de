"""Relative poses of keyframes from odometry and accepted loops: shortest paths in the graph of both."""

from __future__ import annotations

import functools
from collections.abc import Container
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import dijkstra

from stereo_sfm.geometry import se3
from stereo_sfm.mapping.columns import Columns, column
from stereo_sfm.mapping.culling import SAME_VIEW_DEG, SAME_VIEW_DEPTHS
from stereo_sfm.types import F64, I64, Bool

NEAR_METRES, NEAR_RADIANS = 1.5, 0.7  # between keyframes with overlapping views, of shelves a few metres away
# Of the distance at the speed before the gap: from its middle to 1.25 times it, at half the speed more.
GAP_SHARE = 0.75
SPEED_NS = 1_000_000_000  # before a gap, over which it is measured: what covers a camera disturbs its last few poses
REMEMBERED = 4096  # results of each kind since the last loop: a few megabytes
NEWEST = 128  # keyframes, and twice as many loops, that stay, candidates or not; of the loops between two submaps half
FEWEST = 8 * NEWEST  # keyframes, at which some are forgotten for the first time
AROUND_A_GAP = 10  # keyframes before a gap in tracking that stay, for the velocity there: a second has fewer


@dataclass(frozen=True, eq=False)
class GraphPath:
    """The shortest path from keyframe a to keyframe b."""

    a_T_b: F64  # (4, 4) composed along the path
    metres: float  # of odometry on it, to which its drift is proportional
    sigmas: F64  # (2,) metres, radians: of odometry on it that is in doubt


@dataclass(frozen=True, eq=False)
class GapMotion:
    """The motion during a loss of tracking that a loop implies, compared with a prediction from the speed before."""

    deviation: float  # metres between the implied and the predicted position after the gap
    tolerance: float  # metres, largest deviation of a robot that stops, turns or accelerates, without noise
    disturbed: float  # metres, the same if what covers the camera took its poses along in the second before
    distance: float  # metres of odometry between the gap and the loop's two ends


class _Nodes(Columns):
    """One row for each keyframe."""

    kf_id: I64 = column(np.int64, -1)  # ascending
    stamp_ns: I64 = column(np.int64, 0)
    submap: I64 = column(np.int64, 0)  # number of the uninterrupted part of the odometry
    odom_T_cam: F64 = column(np.float64, np.eye(4), (4, 4))  # (K, 4, 4)
    anchored: F64 = column(np.float64, np.eye(4), (4, 4))  # corrected at each loop to the pose of its older end
    frame: I64 = column(np.int64, 0)  # the submap whose frame `anchored` is in
    distance: F64 = column(np.float64, 0.0)  # metres since the start
    doubt: F64 = column(np.float64, 0.0, (2,))  # m^2, rad^2 since the start
    kept: Bool = column(np.bool_, True)  # False: no longer a candidate


class _Loops(Columns):
    """One row for each accepted loop."""

    ends: I64 = column(np.int64, -1, (2,))  # (L, 2) rows of the keyframes a and b
    a_T_b: F64 = column(np.float64, np.eye(4), (4, 4))  # (L, 4, 4)


class KeyframeGraph:
    """Keyframes in order of time; consecutive ones are linked by odometry unless tracking restarted between them."""

    def __init__(self) -> None:
        self._nodes, self._loops = _Nodes(), _Loops()
        self._joined: dict[int, int] = {}  # submap -> number of the group of submaps that loops connect
        self._rigid: set[int] = set()  # submaps
        # What the last loop changed: its newer end, where that was anchored, and the groups.
        self._before_loop: tuple[int, F64, int, dict[int, int]] | None = None
        self._forget_at = FEWEST
        self.path = functools.lru_cache(REMEMBERED)(self._find_path)

    def _row(self, kf_id: int) -> int:
        return int(np.searchsorted(self._nodes.kf_id, kf_id))

    def _known(self, kf_id: int) -> bool:
        row = self._row(kf_id)
        return row < len(self._nodes) and int(self._nodes.kf_id[row]) == kf_id

    def add(
        self,
        kf_id: int,
        odom_T_cam: F64,
        submap: int,
        stamp_ns: int = 0,
        doubt: F64 | float = 0.0,
        rigid: bool = False,
    ) -> None:
        """Append the newest keyframe.

        Args:
            submap: number of the uninterrupted part of the odometry it belongs to. doubt: (2,) m^2, rad^2, see
                `Keyframe.doubt`.
            rigid: the submap is a map in one piece: its keyframes are as far from each other as they lie.
        """
        anchored, frame, distance = odom_T_cam, submap, 0.0
        if len(self._nodes):
            last = self._nodes.odom_T_cam[-1]
            doubt = self._nodes.doubt[-1] + doubt
            step = 0.0 if rigid else float(np.linalg.norm(odom_T_cam[:3, 3] - last[:3, 3]))
            distance = float(self._nodes.distance[-1]) + step
            if self._nodes.submap[-1] == submap:
                anchored, frame = self._nodes.anchored[-1] @ se3.inverse(last) @ odom_T_cam, self._nodes.frame[-1]
        self._joined.setdefault(submap, submap)
        if rigid:
            self._rigid.add(submap)
        self._nodes.append(
            1, kf_id=kf_id, stamp_ns=stamp_ns, submap=submap, odom_T_cam=odom_T_cam, anchored=anchored, frame=frame,
            distance=distance, doubt=doubt,
        )  # fmt: skip

    def exclude(self, kf_id: int) -> None:
        """Remove a keyframe from the candidates; paths over it stay."""
        self._nodes.kept[self._row(kf_id)] = False

    def forget(self) -> I64 | None:
        """Forget keyframes that are no candidates, when there are many: a robot may go round all day.

        The ends of loops stay, and with them what connects the candidates: of loops to keyframes that are no candidates
        any more the newest, and the newest between any two parts of the odometry.

        Returns:
            Rows that stay, of all so far; None: all of them.
        """
        nodes, loops = self._nodes, self._loops
        count = len(nodes)
        if count < self._forget_at:
            return None
        a, b = loops.ends.T
        needed = (nodes.kept[a] & nodes.kept[b]) | _newest_between(nodes.submap[a], nodes.submap[b])
        needed |= np.arange(len(loops)) >= len(loops) - 2 * NEWEST
        stay = nodes.kept | (np.arange(count) >= count - NEWEST)
        stay[loops.ends[needed].ravel()] = True
        for row in np.flatnonzero(nodes.submap[1:] != nodes.submap[:-1]).tolist():
            stay[max(row + 1 - AROUND_A_GAP, 0) : row + 2] = True
        rows = np.flatnonzero(stay)
        loops.keep(np.flatnonzero(needed))
        loops.ends[:] = np.searchsorted(rows, loops.ends)
        nodes.keep(rows)
        self.path.cache_clear()
        self._forget_at = 2 * len(rows) + FEWEST
        return rows

    def unbroken(self, a: int, b: int) -> bool:
        """Whether odometry connects two keyframes without interruption."""
        submap = self._nodes.submap
        return self._known(a) and bool(submap[self._row(a)] == submap[self._row(b)])

    def same_view(self, kf_id: int, factor: float = 1.0) -> list[int]:
        """Keyframes with about the same pose, this one included, oldest first; within `factor` times the distance."""
        nodes, row = self._nodes, self._row(kf_id)
        metres = factor * 2 * SAME_VIEW_DEPTHS  # as in the map where shelves are two metres away
        rows, _, radians = self._around(nodes.anchored, row, nodes.frame, metres)
        return nodes.kf_id[rows[(radians < np.deg2rad(SAME_VIEW_DEG)) | (rows == row)]].tolist()

    def around(self, kf_id: int) -> tuple[I64, F64]:
        """Ids (K,) of all keyframes and their poses (K, 4, 4) in the camera of one, NaN where nothing leads there."""
        nodes, row = self._nodes, self._row(kf_id)
        poses = se3.inverse(nodes.anchored[row]) @ nodes.anchored
        poses[nodes.frame != nodes.frame[row]] = np.nan
        return nodes.kf_id, poses

    def nearby(self, kf_id: int, excluded: Container[int]) -> list[int]:
        """The nearest keyframe of the same submap with an overlapping view, if there is one."""
        nodes, row = self._nodes, self._row(kf_id)
        rows, metres, radians = self._around(nodes.odom_T_cam, row, nodes.submap, NEAR_METRES)
        difference = metres + 1 - np.cos(radians)
        for k in np.argsort(difference, kind="stable").tolist():
            if radians[k] < NEAR_RADIANS and int(nodes.kf_id[rows[k]]) not in excluded:
                return [int(nodes.kf_id[rows[k]])]
        return []

    def _around(self, poses: F64, row: int, frame: I64, reach: float) -> tuple[I64, F64, F64]:
        """Kept rows whose poses are in the same frame as that of `row` and nearer than `reach`; metres and radians."""
        rows = np.flatnonzero(self._nodes.kept & (frame == frame[row]))
        rows = rows[np.linalg.norm(poses[rows, :3, 3] - poses[row, :3, 3], axis=1) < reach]
        return rows, *se3.extent(se3.inverse(poses[rows]) @ poses[row])

    def add_loop(self, a: int, b: int, a_T_b: F64) -> None:
        """Link two keyframes whose relative pose was verified."""
        self.path.cache_clear()
        nodes, row_a, row_b = self._nodes, self._row(a), self._row(b)
        self._before_loop = b, nodes.anchored[row_b].copy(), int(nodes.frame[row_b]), self._joined
        self._loops.append(1, ends=(row_a, row_b), a_T_b=a_T_b)
        nodes.anchored[row_b], nodes.frame[row_b] = nodes.anchored[row_a] @ a_T_b, nodes.frame[row_a]
        keep, dropped = self._joined[int(nodes.submap[row_a])], self._joined[int(nodes.submap[row_b])]
        self._joined = {submap: keep if group == dropped else group for submap, group in self._joined.items()}

    def take_back_loop(self, a: int, b: int) -> None:
        """Without the last loop, which was between these two."""
        assert self._before_loop is not None and self._before_loop[0] == b and self._known(a)
        nodes, row = self._nodes, self._row(b)
        self._loops.keep(np.arange(len(self._loops) - 1))
        _, nodes.anchored[row], nodes.frame[row], self._joined = self._before_loop
        self._before_loop = None
        self.path.cache_clear()

    def gap_motion(self, a: int, b: int, a_T_b: F64) -> GapMotion | None:
        """The motion over the shortest gap between two submaps that a loop between them implies; None without a gap.

        Without tracking a robot may continue, stop, turn or accelerate by half: all its positions are in a ball around
        the middle of the distance at its last speed.
        """
        nodes = self._nodes
        submaps, submap_of = np.unique(nodes.submap, return_inverse=True)
        group = np.array([self._joined[submap] for submap in submaps.tolist()])[submap_of]
        ours = {group[self._row(a)], group[self._row(b)]}
        gaps = [
            (int(nodes.stamp_ns[k + 1] - nodes.stamp_ns[k]), k, velocity)
            for k in np.flatnonzero(group[1:] != group[:-1]).tolist()
            if {group[k], group[k + 1]} == ours
            and nodes.stamp_ns[k + 1] > nodes.stamp_ns[k]
            and (velocity := self._velocity(k)) is not None
        ]
        if not gaps:
            return None
        ns, k, velocity = min(gaps, key=lambda gap: gap[:2])
        if group[self._row(a)] != group[k]:
            a, b, a_T_b = b, a, se3.inverse(a_T_b)
        before, after = self.path(int(nodes.kf_id[k]), a), self.path(b, int(nodes.kf_id[k + 1]))
        assert before is not None and after is not None
        moved = before.a_T_b @ a_T_b @ after.a_T_b
        deviation = float(np.linalg.norm(moved[:3, 3] - 0.5e-9 * ns * velocity))
        speed = max(float(np.linalg.norm(velocity)), 0.5)  # metres a second: a robot that stands may start
        tolerance = GAP_SHARE * 1e-9 * ns * speed
        disturbed = tolerance + GAP_SHARE * 1e-9 * SPEED_NS * speed
        return GapMotion(deviation, tolerance, disturbed, before.metres + after.metres)

    def _velocity(self, row: int) -> F64 | None:
        """(3,) metres a second before a keyframe, in its camera frame; None for the first of a submap.

        Over a second at least, if the submap is as long: what covers a camera disturbs its last few poses.
        """
        nodes = self._nodes
        submap = np.flatnonzero(nodes.submap[:row] == nodes.submap[row])
        early = submap[nodes.stamp_ns[submap] <= nodes.stamp_ns[row] - SPEED_NS]
        before = int(early[-1]) if len(early) else int(submap[0]) if len(submap) else row
        if nodes.stamp_ns[row] <= nodes.stamp_ns[before]:
            return None
        step = se3.inverse(nodes.odom_T_cam[row]) @ nodes.odom_T_cam[before]
        return -step[:3, 3] / (1e-9 * float(nodes.stamp_ns[row] - nodes.stamp_ns[before]))

    def _find_path(self, a: int, b: int) -> GraphPath | None:
        """The shortest path (Dijkstra), None if nothing connects the keyframes or one is forgotten."""
        if not (self._known(a) and self._known(b)):
            return None
        nodes, loops = self._nodes, self._loops.ends
        rows = np.unique(np.append(loops.ravel(), (self._row(a), self._row(b))))
        linked = np.flatnonzero(nodes.submap[rows[:-1]] == nodes.submap[rows[1:]])
        ends = np.concatenate([np.stack([linked, linked + 1], 1), np.searchsorted(rows, loops)])
        metres = np.zeros(len(ends))
        metres[: len(linked)] = nodes.distance[rows[linked + 1]] - nodes.distance[rows[linked]]
        start, goal = np.searchsorted(rows, (self._row(a), self._row(b))).tolist()
        path = _shortest_path(ends, metres, len(rows), start, goal)
        if path is None:
            return None
        a_T_b, total, doubt = np.eye(4), 0.0, np.zeros(2)
        across = np.eye(4)  # a rigid submap, straight
        for k, forward in path:
            p, q = rows[ends[k]]
            odometry = se3.inverse(nodes.odom_T_cam[p]) @ nodes.odom_T_cam[q] if k < len(linked) else None
            p_T_q = self._loops.a_T_b[k - len(linked)] if odometry is None else odometry
            step = p_T_q if forward else se3.inverse(p_T_q)
            a_T_b = a_T_b @ step
            if k < len(linked) and int(nodes.submap[p]) in self._rigid:
                across = across @ step
                continue
            total += float(metres[k] + np.linalg.norm(across[:3, 3]))
            across = np.eye(4)
            doubt += nodes.doubt[q] - nodes.doubt[p] if k < len(linked) else 0.0
        return GraphPath(a_T_b, total + float(np.linalg.norm(across[:3, 3])), np.sqrt(doubt))


def _newest_between(a: I64, b: I64) -> Bool:
    """(L,) which loops between submaps (L,) and (L,), in order of time, are the newest between two different ones."""
    _, pair = np.unique(np.stack([np.minimum(a, b), np.maximum(a, b)], 1), axis=0, return_inverse=True)
    pair = pair.ravel()
    order = np.argsort(pair, kind="stable")
    later = np.empty(len(a), np.int64)  # loops between the same two that came later
    later[order] = np.cumsum(np.bincount(pair))[pair[order]] - 1 - np.arange(len(a))
    return (a != b) & (later < NEWEST // 2)


def _shortest_path(ends: I64, metres: F64, count: int, start: int, goal: int) -> list[tuple[int, bool]] | None:
    """Rows of the edges (E, 2) from start to goal, each with whether it is traversed from its first end to its second.

    Of edges between the same nodes the shortest counts, of equals the first.
    """
    if start == goal:
        return []
    shortest: dict[tuple[int, int], int] = {}
    for k in np.argsort(metres, kind="stable").tolist():
        shortest.setdefault((int(ends[k].min()), int(ends[k].max())), k)
    pairs = sorted(shortest)
    lengths = metres[[shortest[pair] for pair in pairs]] + 1e-6  # of equally long paths the one with fewer edges counts
    graph = scipy.sparse.coo_array((lengths, np.array(pairs).reshape(-1, 2).T), shape=(count, count)).tocsr()
    distance, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    if not np.isfinite(distance[goal]):
        return None
    path: list[tuple[int, bool]] = []
    while goal != start:
        last = int(before[goal])
        edge = shortest[min(last, goal), max(last, goal)]
        path.append((edge, int(ends[edge, 0]) == last))
        goal = last
    return path[::-1]
