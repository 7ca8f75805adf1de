"""What is known of the way between two keyframes: odometry along the walk, and accepted loops as short cuts."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Container
from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, I64

NEAR_METRES, NEAR_RADIANS = 1.5, 0.7  # keyframes that should see the same things
SAME_METRES, SAME_RADIANS = 0.3, 0.25  # keyframes that show the same view


@dataclass(frozen=True, eq=False)
class Way:
    """The shortest known way from keyframe a to keyframe b."""

    a_T_b: F64  # (4, 4) composed along it
    metres: float  # walked on it: the drift it may hold grows with this


class KeyframeGraph:
    """Keyframes in order of time; consecutive ones are linked by odometry unless tracking restarted between them."""

    def __init__(self) -> None:
        self._poses: dict[int, F64] = {}  # odom_T_cam
        self._metres: dict[int, float] = {}  # walked since the start
        self._chain: dict[int, int] = {}  # number of the unbroken piece of odometry
        self._loops: list[tuple[int, int, F64]] = []  # a, b, a_T_b
        self._last = -1
        self._ids: I64 = np.zeros(64, np.int64)
        self._stack: F64 = np.empty((64, 4, 4))  # odom_T_cam of _ids, for vectorised search
        self._anchored: F64 = np.empty((64, 4, 4))  # the same, taken back at each loop to where its older end stood
        self._chains: I64 = np.zeros(64, np.int64)
        self._frames: I64 = np.zeros(64, np.int64)  # the chain whose coordinates _anchored is in
        self._count = 0

    def add(self, kf_id: int, odom_T_cam: F64, chain: int) -> None:
        """Append the newest keyframe of an unbroken piece of odometry called `chain`."""
        step = np.linalg.norm(odom_T_cam[:3, 3] - self._poses[self._last][:3, 3]) if self._last >= 0 else 0.0
        self._metres[kf_id] = self._metres.get(self._last, 0.0) + float(step)
        self._poses[kf_id], self._chain[kf_id], self._last = odom_T_cam, chain, kf_id
        if self._count == len(self._ids):
            self._ids, self._stack = np.tile(self._ids, 2), np.tile(self._stack, (2, 1, 1))
            self._chains, self._frames = np.tile(self._chains, 2), np.tile(self._frames, 2)
            self._anchored = np.tile(self._anchored, (2, 1, 1))
        self._ids[self._count], self._stack[self._count], self._chains[self._count] = kf_id, odom_T_cam, chain
        self._anchored[self._count], self._frames[self._count] = odom_T_cam, chain
        if self._count and self._chains[self._count - 1] == chain:
            moved = se3.inverse(self._stack[self._count - 1]) @ odom_T_cam
            self._anchored[self._count] = self._anchored[self._count - 1] @ moved
            self._frames[self._count] = self._frames[self._count - 1]
        self._count += 1

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

    def way(self, a: int, b: int) -> Way | None:
        """The way with the fewest metres, or None where tracking broke and no loop joins the pieces (Dijkstra)."""
        nodes = sorted({a, b, *(n for loop in self._loops for n in loop[:2])}, key=lambda n: (self._chain[n], n))
        edges: dict[int, list[tuple[int, float, F64]]] = {n: [] for n in nodes}
        for p, q in itertools.pairwise(nodes):
            if self._chain[p] == self._chain[q]:
                self._link(edges, p, q, se3.inverse(self._poses[p]) @ self._poses[q], self._metres[q] - self._metres[p])
        for p, q, p_T_q in self._loops:
            self._link(edges, p, q, p_T_q, 0.0)
        heap: list[tuple[float, int]] = [(0.0, a)]
        poses, done = {a: np.eye(4)}, set[int]()
        lowest = {a: 0.0}
        while heap:
            metres, node = heapq.heappop(heap)
            if node == b:
                return Way(poses[b], metres)
            if node in done:
                continue
            done.add(node)
            for other, length, node_T_other in edges[node]:
                if metres + length < lowest.get(other, np.inf):
                    lowest[other] = metres + length
                    poses[other] = poses[node] @ node_T_other
                    heapq.heappush(heap, (metres + length, other))
        return None

    @staticmethod
    def _link(edges: dict[int, list[tuple[int, float, F64]]], p: int, q: int, p_T_q: F64, length: float) -> None:
        edges[p].append((q, length, p_T_q))
        edges[q].append((p, length, se3.inverse(p_T_q)))
