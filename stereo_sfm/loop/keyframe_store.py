"""Keyframes of the loop closer and their covisibility."""

from __future__ import annotations

import numpy as np

from stereo_sfm.mapping import map_kernels
from stereo_sfm.mapping.columns import Columns, column
from stereo_sfm.mapping.id_rows import IdRows
from stereo_sfm.types import I32, I64, Keyframe


class _Sightings(Columns):
    """One row for each point of each keyframe; those of a point are a linked list, as in the map."""

    kf: I32 = column(np.int32, -1)  # its number, see `KeyframeStore`
    point: I32 = column(np.int32, -1)  # row of the point, -1: removed
    following: I32 = column(np.int32, -1)  # next older row of the same point, -1: last


class _Points(Columns):
    """One row for each point."""

    head: I32 = column(np.int32, -1)  # newest sighting, -1: none
    merged_into: I32 = column(np.int32, -1)  # row of the same physical point, -1: none


class KeyframeStore:
    """Keyframes by id. Point ids that a loop has associated count as one point."""

    def __init__(self) -> None:
        self._keyframes: dict[int, Keyframe] = {}
        self._rows: dict[int, tuple[int, int]] = {}  # keyframe id -> its first sighting, number of them
        # Each keyframe has a number below the most that there ever were at a time: ids grow for ever.
        self._numbered: list[int] = []  # ids by number
        self._free: list[int] = []  # numbers
        self._sightings = _Sightings()
        self._points = _Points()
        self._point_rows = IdRows()
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

    @property
    def known_points(self) -> int:
        """Ids of points that the kept keyframes see, and of others until the next compaction."""
        return len(self._point_rows)

    @property
    def _lists(self) -> map_kernels.Lists:
        table = self._sightings
        return map_kernels.Lists(self._points.head, table.following, table.kf, table.point)

    def _find(self, point_ids: I64) -> I64:
        """(N,) row of each point after merges, -1 where it is unknown."""
        rows = self._point_rows.find(point_ids)
        map_kernels.follow(rows, self._points.merged_into)
        return rows

    def _know(self, point_ids: I64) -> I64:
        """(N,) row of each point after merges; unknown ones are added."""
        new = np.unique(point_ids[self._point_rows.find(point_ids) < 0])
        added = self._points.append(len(new))
        self._point_rows.add(new, np.arange(added.start, added.stop))
        return self._find(point_ids)

    def add(self, keyframe: Keyframe) -> None:
        """Add a keyframe."""
        self._keyframes[keyframe.kf_id] = keyframe
        self.ids.append(keyframe.kf_id)
        number = self._free.pop() if self._free else len(self._numbered)
        self._numbered[number : number + 1] = [keyframe.kf_id]
        points = np.unique(self._know(np.asarray(keyframe.point_ids)))
        rows = self._sightings.append(len(points), kf=number, point=points)
        self._rows[keyframe.kf_id] = rows.start, len(points)
        map_kernels.link(rows.start, self._lists)

    def remove(self, kf_id: int) -> None:
        """Remove a keyframe."""
        self.ids.remove(kf_id)
        del self._keyframes[kf_id]
        self._free.append(self._numbered.index(kf_id))
        first, count = self._rows.pop(kf_id)
        rows, table = np.arange(first, first + count), self._sightings
        map_kernels.unlink(rows[table.point[rows] >= 0], self._lists)
        if table.much_unused(sum(count for _, count in self._rows.values())):
            self._compact()

    def _compact(self) -> None:
        """Free the rows of removed keyframes, and of points that none of the others sees."""
        table, firsts = self._sightings, np.array([first for first, _ in self._rows.values()], np.int64)
        kept = np.concatenate([np.arange(first, first + count) for first, count in self._rows.values()])
        place = np.full(len(table) + 1, -1, np.int32)  # the last entry is for -1: none
        place[kept] = np.arange(len(kept))
        self._points.head[:] = place[self._points.head]
        table.keep(kept)
        table.following[:] = place[table.following]
        counts = [count for _, count in self._rows.values()]
        self._rows = dict(zip(self._rows, zip(place[firsts].tolist(), counts, strict=True), strict=True))
        self._forget_points()

    def _forget_points(self) -> None:
        """Points stay known by the ids that the keyframes have for them; the newest ones are still followed."""
        known, table, points = self._point_rows, self._sightings, self._points
        known.keep(np.isin(known.ids, np.concatenate([k.point_ids for k in self._keyframes.values()])))
        known.rows[:] = self._find(known.ids)
        kept = np.unique(known.rows).astype(np.int64)
        place = np.full(len(points) + 1, -1, np.int32)  # the last entry is for -1: none
        place[kept] = np.arange(len(kept))
        known.rows[:] = place[known.rows]
        table.point[:] = place[table.point]
        points.keep(kept)

    def merge(self, pairs: I64) -> None:
        """(M, 2) point ids: the second is the same physical point as the first."""
        for k in range(len(pairs)):
            root, merged_root = self._know(pairs[k]).tolist()
            if root == merged_root:
                continue
            points, lists = self._points, self._lists
            both = np.empty(len(self.ids), np.int64)  # a keyframe with both ids counts once
            count = map_kernels.seen_together(merged_root, root, lists, both)
            map_kernels.unlink(both[:count], lists)
            map_kernels.hand_over(merged_root, root, lists)
            points.head[merged_root], points.merged_into[merged_root] = -1, root

    def _shared(self, point_ids: I64) -> tuple[I64, I64]:
        """(K,) ids of the keyframes that see some of these points, ascending, and (K,) how many."""
        points = np.unique(self._find(point_ids))
        points = points[points >= 0]
        counts = np.zeros(len(self._numbered), np.int64)
        map_kernels.count_by_keyframe(points, self._lists, counts)
        seeing = np.flatnonzero(counts)
        ids = np.array(self._numbered, np.int64)[seeing]
        order = np.argsort(ids)
        return ids[order], counts[seeing[order]]

    def connected(self, point_ids: I64, min_points: int) -> list[int]:
        """Keyframes that share at least `min_points` of these points, ascending."""
        ids, counts = self._shared(point_ids)
        return ids[counts >= min_points].tolist()

    def best_connected(self, kf_id: int, count: int) -> list[int]:
        """The `count` keyframes that share most points with this one, best first, ties to the older."""
        ids, counts = self._shared(np.asarray(self._keyframes[kf_id].point_ids))
        ids, counts = ids[ids != kf_id], counts[ids != kf_id]
        return ids[np.argsort(-counts, kind="stable")][:count].tolist()
