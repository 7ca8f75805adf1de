"""Keyframes of the loop closer and their covisibility."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from stereo_sfm.mapping.columns import FEW, SPARE, Columns, IdRows, column
from stereo_sfm.types import I32, I64, Keyframe


class _Sightings(Columns):
    """One row for each point of each keyframe."""

    kf: I32 = column(np.int32, -1)  # its place in `KeyframeStore.ids`
    point: I32 = column(np.int32, -1)  # number of the physical point


class KeyframeStore:
    """Keyframes by ascending id. Point ids that a loop has associated count as one point.

    A question about covisibility reads all sightings: a millisecond for some thousand keyframes.
    """

    def __init__(self) -> None:
        self._keyframes: dict[int, Keyframe] = {}
        self._sightings = _Sightings()
        self._points = IdRows()  # numbers of physical points by their ids
        self._count = 0  # of numbers
        self._removed = 0  # sightings, since points were forgotten
        self.ids: list[int] = []

    def __getitem__(self, kf_id: int) -> Keyframe:
        return self._keyframes[kf_id]

    def __contains__(self, kf_id: int) -> bool:
        return kf_id in self._keyframes

    def __len__(self) -> int:
        return len(self.ids)

    def _know(self, point_ids: I64) -> I64:
        """(N,) number of each point; unknown ones are added."""
        new = np.unique(point_ids[self._points.find(point_ids) < 0])
        self._points.add(new, self._count + np.arange(len(new)))
        self._count += len(new)
        return self._points.find(point_ids)

    def add(self, keyframe: Keyframe) -> None:
        """Add the newest keyframe."""
        points = np.unique(self._know(keyframe.point_ids))
        self._sightings.append(len(points), kf=len(self.ids), point=points)
        self._keyframes[keyframe.kf_id] = keyframe
        self.ids.append(keyframe.kf_id)

    def remove(self, kf_id: int) -> None:
        """Remove a keyframe."""
        place, table = self.ids.index(kf_id), self._sightings
        del self._keyframes[kf_id], self.ids[place]
        stay = table.kf != place
        self._removed += np.count_nonzero(~stay)
        table.keep(np.flatnonzero(stay))
        table.kf[table.kf > place] -= 1
        if self._removed > len(table) // SPARE + FEW:
            self._forget_points()

    def _forget_points(self) -> None:
        """Points stay known by the ids that the keyframes have for them; the newest ones are still followed."""
        known = self._points
        known.keep(np.isin(known.ids, np.concatenate([k.point_ids for k in self._keyframes.values()])))
        used = np.unique(known.rows)
        number = np.full(self._count, -1, np.int32)
        number[used] = np.arange(len(used))
        self._count, self._removed = len(used), 0
        self._renumber(number)

    def merge(self, pairs: I64) -> None:
        """(M, 2) point ids: both are the same physical point."""
        if not len(pairs):
            return
        first, second = self._know(pairs.ravel()).reshape(-1, 2).T
        same = scipy.sparse.coo_array((np.ones(len(first)), (first, second)), shape=(self._count, self._count))
        self._count, number = connected_components(same, directed=False)
        self._renumber(number)
        table = self._sightings
        _, once = np.unique(table.kf * np.int64(self._count) + table.point, return_index=True)
        table.keep(np.sort(once))  # a keyframe with both ids counts once

    def _renumber(self, number: I32) -> None:
        """Give points other numbers."""
        self._points.rows[:] = number[self._points.rows]
        self._sightings.point[:] = number[self._sightings.point]

    def _shared(self, point_ids: I64) -> I64:
        """(K,) how many of these points each keyframe sees."""
        points, asked = self._points.find(point_ids), np.zeros(self._count, bool)
        asked[points[points >= 0]] = True
        return np.bincount(self._sightings.kf[asked[self._sightings.point]], minlength=len(self.ids))

    def connected(self, point_ids: I64, min_points: int) -> list[int]:
        """Keyframes that share at least `min_points` of these points, ascending."""
        return [self.ids[k] for k in np.flatnonzero(self._shared(point_ids) >= min_points).tolist()]

    def best_connected(self, kf_id: int, count: int) -> list[int]:
        """The `count` keyframes that share most points with this one, best first, ties to the older."""
        counts = self._shared(self._keyframes[kf_id].point_ids)
        counts[self.ids.index(kf_id)] = 0
        best = np.argsort(-counts, kind="stable")[:count]
        return [self.ids[k] for k in best[counts[best] > 0].tolist()]
