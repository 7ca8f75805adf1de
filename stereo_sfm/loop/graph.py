"""What is known of the way between two keyframes: odometry along the walk, and accepted loops as short cuts."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import dijkstra

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, I64

NEAR_METRES, NEAR_RADIANS = 1.5, 0.7  # keyframes that should see the same things
SAME_METRES, SAME_RADIANS = 0.3, 0.25  # keyframes that show the same view
GAP_METRES, GAP_SHARE, SLOW = 0.3, 0.75, 0.5  # reach without tracking: metres, share of the way, least metres a second
HOP_METRES = 1e-6  # added to each edge of a way: of equal ways the one with fewer edges


@dataclass(frozen=True, eq=False)
class Way:
    """The shortest known way from keyframe a to keyframe b."""

    a_T_b: F64  # (4, 4) composed along it
    metres: float  # walked on it: the drift it may hold grows with this


@dataclass(frozen=True, eq=False)
class Jump:
    """What a loop says of the motion while tracking was lost, beside what the robot's speed before says."""

    off: float  # metres between where the loop puts the camera after the gap and where it is expected
    radius: float  # metres by which a robot that stops, turns or hurries can be off
    walked: float  # metres of odometry between the gap and the loop's two ends


class KeyframeGraph:
    """Keyframes in order of time; consecutive ones are linked by odometry unless tracking restarted between them."""

    def __init__(self) -> None:
        self._poses: dict[int, F64] = {}  # odom_T_cam
        self._chain: dict[int, int] = {}  # number of the unbroken piece of odometry
        self._loops: list[tuple[int, int, F64]] = []  # a, b, a_T_b
        self._last = -1
        self._ids: I64 = np.zeros(64, np.int64)
        self._stack: F64 = np.empty((64, 4, 4))  # odom_T_cam of _ids, for vectorised search
        self._anchored: F64 = np.empty((64, 4, 4))  # the same, taken back at each loop to where its older end stood
        self._chains: I64 = np.zeros(64, np.int64)
        self._walked: F64 = np.zeros(64)  # metres since the start
        self._stamps: I64 = np.zeros(64, np.int64)
        self._joined: dict[int, int] = {}  # number of the chains' group that loops hold together
        self._frames: I64 = np.zeros(64, np.int64)  # the chain whose coordinates _anchored is in
        self._count = 0

    def add(self, kf_id: int, odom_T_cam: F64, chain: int, stamp_ns: int = 0) -> None:
        """Append the newest keyframe of an unbroken piece of odometry called `chain`."""
        step = np.linalg.norm(odom_T_cam[:3, 3] - self._poses[self._last][:3, 3]) if self._last >= 0 else 0.0
        self._poses[kf_id], self._chain[kf_id], self._last = odom_T_cam, chain, kf_id
        if self._count == len(self._ids):
            self._ids, self._stack = np.tile(self._ids, 2), np.tile(self._stack, (2, 1, 1))
            self._chains, self._frames = np.tile(self._chains, 2), np.tile(self._frames, 2)
            self._anchored, self._walked = np.tile(self._anchored, (2, 1, 1)), np.tile(self._walked, 2)
            self._stamps = np.tile(self._stamps, 2)
        self._stamps[self._count] = stamp_ns
        self._joined.setdefault(chain, chain)
        self._ids[self._count], self._stack[self._count], self._chains[self._count] = kf_id, odom_T_cam, chain
        self._anchored[self._count], self._frames[self._count] = odom_T_cam, chain
        self._walked[self._count] = (self._walked[self._count - 1] if self._count else 0.0) + float(step)
        if self._count and self._chains[self._count - 1] == chain:
            moved = se3.inverse(self._stack[self._count - 1]) @ odom_T_cam
            self._anchored[self._count] = self._anchored[self._count - 1] @ moved
            self._frames[self._count] = self._frames[self._count - 1]
        self._count += 1

    def unbroken(self, a: int, b: int) -> bool:
        """Whether odometry leads from one keyframe to the other."""
        return a in self._chain and self._chain[a] == self._chain[b]

    def same_view(self, kf_id: int) -> list[int]:
        """Keyframes, this one among them, that stood where it stood and looked where it looked, oldest first."""
        part = slice(0, self._count)
        row = int(np.searchsorted(self._ids[part], kf_id))
        metres, radians = se3.extent(se3.inverse(self._anchored[part]) @ self._anchored[row])
        same = (metres < SAME_METRES) & (radians < SAME_RADIANS) & (self._frames[part] == self._frames[row])
        return self._ids[part][same].tolist()

    def nearby(self, kf_id: int, excluded: Container[int]) -> list[int]:
        """The keyframe of the same piece of odometry that stood nearest and looked the same way, if near at all."""
        part = slice(0, self._count)
        metres, radians = se3.extent(se3.inverse(self._stack[part]) @ self._poses[kf_id])
        close = (metres < NEAR_METRES) & (radians < NEAR_RADIANS) & (self._chains[part] == self._chain[kf_id])
        rows = [r for r in np.flatnonzero(close).tolist() if int(self._ids[r]) not in excluded]
        return [int(self._ids[min(rows, key=lambda r: (metres[r] + 1 - np.cos(radians[r]), r))])] if rows else []

    def add_loop(self, a: int, b: int, a_T_b: F64) -> None:
        """Link two keyframes whose relative pose was verified."""
        self._loops.append((a, b, a_T_b))
        row_a, row_b = np.searchsorted(self._ids[: self._count], (a, b)).tolist()
        self._anchored[row_b], self._frames[row_b] = self._anchored[row_a] @ a_T_b, self._frames[row_a]
        keep, gone = self._joined[self._chain[a]], self._joined[self._chain[b]]
        self._joined = {chain: keep if group == gone else group for chain, group in self._joined.items()}

    def jump(self, a: int, b: int, a_T_b: F64) -> Jump | None:
        """What a loop between two pieces of the walk says of the shortest gap between them; None where none is known.

        In the dark a robot goes on as before, stops, turns or goes half as fast again: all this is in a ball around the
        middle of the way that its speed makes likely.
        """
        group = np.array([self._joined[chain] for chain in self._chains[: self._count].tolist()])
        ours = {self._joined[self._chain[a]], self._joined[self._chain[b]]}
        gaps = [
            (int(self._stamps[k + 1] - self._stamps[k]), k, velocity)
            for k in np.flatnonzero(group[1:] != group[:-1]).tolist()
            if {group[k], group[k + 1]} == ours
            and self._stamps[k + 1] > self._stamps[k]
            and (velocity := self._velocity(k)) is not None
        ]
        if not gaps:
            return None
        ns, k, velocity = min(gaps, key=lambda gap: gap[:2])
        if self._joined[self._chain[a]] != group[k]:
            a, b, a_T_b = b, a, se3.inverse(a_T_b)
        before, after = self.way(int(self._ids[k]), a), self.way(b, int(self._ids[k + 1]))
        assert before is not None and after is not None
        moved = before.a_T_b @ a_T_b @ after.a_T_b
        off = float(np.linalg.norm(moved[:3, 3] - 0.5e-9 * ns * velocity))
        radius = GAP_METRES + GAP_SHARE * 1e-9 * ns * max(float(np.linalg.norm(velocity)), SLOW)
        return Jump(off, radius, before.metres + after.metres)

    def _velocity(self, row: int) -> F64 | None:
        """(3,) metres a second before a keyframe, in its camera; None for the first of a piece."""
        if row == 0 or self._chains[row - 1] != self._chains[row] or self._stamps[row] <= self._stamps[row - 1]:
            return None
        step = se3.inverse(self._stack[row]) @ self._stack[row - 1]
        return -step[:3, 3] / (1e-9 * float(self._stamps[row] - self._stamps[row - 1]))

    def way(self, a: int, b: int) -> Way | None:
        """The way with the fewest metres, or None where tracking broke and no loop joins the pieces (Dijkstra)."""
        loops = np.array([loop[:2] for loop in self._loops], np.int64).reshape(-1, 2)
        rows = np.unique(np.searchsorted(self._ids[: self._count], np.append(loops.ravel(), (a, b))))
        nodes = self._ids[rows]
        linked = np.flatnonzero(self._chains[rows[:-1]] == self._chains[rows[1:]])
        ends = np.concatenate([np.stack([linked, linked + 1], 1), np.searchsorted(nodes, loops)])
        metres = np.zeros(len(ends))
        metres[: len(linked)] = self._walked[rows[linked + 1]] - self._walked[rows[linked]]
        best = _shortest_of_each_pair(ends, metres)
        start, goal = np.searchsorted(nodes, (a, b)).tolist()
        path = _shortest_path(len(nodes), ends[best], metres[best], start, goal)
        if path is None:
            return None
        a_T_b, total = np.eye(4), 0.0
        for edge, forward in path:
            k = int(best[edge])
            p, q = nodes[ends[k]].tolist()
            p_T_q = (
                self._loops[k - len(linked)][2] if k >= len(linked) else se3.inverse(self._poses[p]) @ self._poses[q]
            )
            a_T_b = a_T_b @ (p_T_q if forward else se3.inverse(p_T_q))
            total += float(metres[k])
        return Way(a_T_b, total)


def _shortest_of_each_pair(ends: I64, metres: F64) -> I64:
    """Rows of the edges (E, 2) that no other edge between the same nodes undercuts; the first of equals."""
    low, high = ends.min(1), ends.max(1)
    order = np.lexsort((np.arange(len(ends)), metres, high, low))
    new = np.ones(len(order), bool)
    new[1:] = (low[order][1:] != low[order][:-1]) | (high[order][1:] != high[order][:-1])
    return order[new & (low[order] != high[order])].astype(np.int64)


def _shortest_path(count: int, ends: I64, metres: F64, start: int, goal: int) -> list[tuple[int, bool]] | None:
    """Edges from start to goal, each with whether it is walked from its first end to its second."""
    if start == goal:
        return []
    graph = scipy.sparse.coo_array((metres + HOP_METRES, (ends[:, 0], ends[:, 1])), shape=(count, count)).tocsr()
    distance, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    if not np.isfinite(distance[goal]):
        return None
    edge_of = {(min(i, j), max(i, j)): k for k, (i, j) in enumerate(ends.tolist())}
    path: list[tuple[int, bool]] = []
    while goal != start:
        last = int(before[goal])
        edge = edge_of[min(last, goal), max(last, goal)]
        path.append((edge, int(ends[edge, 0]) == last))
        goal = last
    return path[::-1]
