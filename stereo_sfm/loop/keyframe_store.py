"""Keyframes of the loop closer and their covisibility."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from stereo_sfm.mapping import map_kernels
from stereo_sfm.mapping.columns import Columns, Spec
from stereo_sfm.types import I32, I64, Keyframe


class _Sightings(Columns):
    """One row for each point of each keyframe; those of a point are a linked list, as in the map."""

    kf: I32  # id
    point: I32  # representative id of the point, -1: removed
    following: I32  # next older row of the same point, -1: last

    SPEC: ClassVar[Spec] = {"kf": (np.int32, (), -1), "point": (np.int32, (), -1), "following": (np.int32, (), -1)}


class KeyframeStore:
    """Keyframes by id. Point ids that a loop has associated count as one point."""

    def __init__(self) -> None:
        self._keyframes: dict[int, Keyframe] = {}
        self._rows: dict[int, tuple[int, int]] = {}  # keyframe id -> its first sighting, number of them
        self._sightings = _Sightings()
        self._head: I32 = np.zeros(0, np.int32)  # by point id: newest row
        self._merged_into: I32 = np.zeros(0, np.int32)  # by point id: another id, -1: none
        self.ids: list[int] = []

    def __getitem__(self, kf_id: int) -> Keyframe:
        return self._keyframes[kf_id]

    def __contains__(self, kf_id: int) -> bool:
        return kf_id in self._keyframes

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def sightings(self) -> int:
        """Rows in use, including those of removed keyframes until the next compaction."""
        return len(self._sightings)

    def _points(self, point_ids: I64) -> I64:
        """(N,) representative ids of points."""
        self._reserve(int(point_ids.max(initial=-1)) + 1)
        points = point_ids.copy()
        map_kernels.follow(points, self._merged_into)
        return points

    def _reserve(self, size: int) -> None:
        """Allocate point ids below `size`."""
        if size > len(self._head):
            more = np.full(max(size, 2 * len(self._head)) - len(self._head), -1, np.int32)
            self._head, self._merged_into = (np.concatenate([a, more]) for a in (self._head, self._merged_into))

    def add(self, keyframe: Keyframe) -> None:
        """Add a keyframe."""
        self._keyframes[keyframe.kf_id] = keyframe
        self.ids.append(keyframe.kf_id)
        points = np.unique(self._points(keyframe.point_ids))
        rows = self._sightings.append(len(points), kf=keyframe.kf_id, point=points)
        self._rows[keyframe.kf_id] = rows.start, len(points)
        map_kernels.link(rows.start, self._head, self._sightings.following, self._sightings.point)

    def remove(self, kf_id: int) -> None:
        """Remove a keyframe."""
        self.ids.remove(kf_id)
        del self._keyframes[kf_id]
        first, count = self._rows.pop(kf_id)
        rows, table = np.arange(first, first + count), self._sightings
        map_kernels.unlink(rows[table.point[rows] >= 0], self._head, table.following, table.point)
        if len(table) > 2 * sum(count for _, count in self._rows.values()) + 4096:
            self._compact()

    def _compact(self) -> None:
        """Free the rows of removed keyframes."""
        table, firsts = self._sightings, np.array([first for first, _ in self._rows.values()], np.int64)
        kept = np.concatenate([np.arange(first, first + count) for first, count in self._rows.values()])
        place = np.full(len(table) + 1, -1, np.int32)  # the last entry is for -1: none
        place[kept] = np.arange(len(kept))
        self._head[:] = place[self._head]
        table.keep(kept)
        table.following[:] = place[table.following]
        counts = [count for _, count in self._rows.values()]
        self._rows = dict(zip(self._rows, zip(place[firsts].tolist(), counts, strict=True), strict=True))

    def merge(self, pairs: I64) -> None:
        """(M, 2) point ids: the second is the same physical point as the first."""
        table = self._sightings
        for k in range(len(pairs)):
            root, merged_root = self._points(pairs[k]).tolist()
            if root == merged_root:
                continue
            both = np.empty(len(self.ids), np.int64)  # a keyframe with both ids counts once
            count = map_kernels.seen_together(merged_root, root, self._head, table.following, table.kf, both)
            map_kernels.unlink(both[:count], self._head, table.following, table.point)
            map_kernels.hand_over(merged_root, root, self._head, table.following, table.point)
            self._head[merged_root], self._merged_into[merged_root] = -1, root

    def _shared(self, point_ids: I64) -> tuple[I64, I64]:
        """(K,) ids of the keyframes that see some of these points, ascending, and (K,) how many."""
        points, table = np.unique(self._points(point_ids)), self._sightings
        counts = np.zeros(max(self.ids, default=-1) + 1, np.int64)
        map_kernels.count_by_keyframe(points, self._head, table.following, table.kf, counts)
        seeing = np.flatnonzero(counts)
        return seeing, counts[seeing]

    def connected(self, point_ids: I64, min_points: int) -> list[int]:
        """Keyframes that share at least `min_points` of these points, ascending."""
        ids, counts = self._shared(point_ids)
        return ids[counts >= min_points].tolist()

    def best_connected(self, kf_id: int, count: int) -> list[int]:
        """The `count` keyframes that share most points with this one, best first, ties to the older."""
        ids, counts = self._shared(np.asarray(self._keyframes[kf_id].point_ids))
        ids, counts = ids[ids != kf_id], counts[ids != kf_id]
        return ids[np.argsort(-counts, kind="stable")][:count].tolist()
