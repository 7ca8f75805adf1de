"""Keyframes that the loop closer has seen, and which of them share points."""

from __future__ import annotations

import numpy as np

from stereo_sfm.types import I64, Keyframe


class KeyframeStore:
    """Keyframes by id. Two point ids that a loop found to be one physical point count as one from then on."""

    def __init__(self) -> None:
        self._keyframes: dict[int, Keyframe] = {}
        self._seen_by: dict[int, list[int]] = {}  # root point id -> keyframes, ascending
        self._parent: dict[int, int] = {}  # point id -> the id it was merged into
        self.ids: list[int] = []

    def __getitem__(self, kf_id: int) -> Keyframe:
        return self._keyframes[kf_id]

    def __len__(self) -> int:
        return len(self.ids)

    def _root(self, point_id: int) -> int:
        while point_id in self._parent:
            point_id = self._parent[point_id]
        return point_id

    def add(self, keyframe: Keyframe) -> None:
        """Remember a keyframe."""
        self._keyframes[keyframe.kf_id] = keyframe
        self.ids.append(keyframe.kf_id)
        for point_id in keyframe.point_ids.tolist():
            self._seen_by.setdefault(self._root(point_id), []).append(keyframe.kf_id)

    def remove(self, kf_id: int) -> None:
        """Forget a keyframe."""
        self.ids.remove(kf_id)
        for point_id in self._keyframes.pop(kf_id).point_ids.tolist():
            root = self._root(point_id)
            left = [k for k in self._seen_by.get(root, ()) if k != kf_id]
            if left:
                self._seen_by[root] = left
            else:
                self._seen_by.pop(root, None)

    def merge(self, pairs: I64) -> None:
        """(M, 2) point ids: the second is the same physical point as the first."""
        for old, new in pairs.tolist():
            keep, drop = self._root(old), self._root(new)
            if keep != drop:
                self._parent[drop] = keep
                self._seen_by[keep] = sorted({*self._seen_by.get(keep, ()), *self._seen_by.pop(drop, ())})

    def _shared(self, point_ids: I64) -> dict[int, int]:
        counts: dict[int, int] = {}
        for root in dict.fromkeys(self._root(p) for p in point_ids.tolist()):
            for kf_id in self._seen_by.get(root, ()):
                counts[kf_id] = counts.get(kf_id, 0) + 1
        return counts

    def connected(self, point_ids: I64, min_points: int) -> list[int]:
        """Keyframes that share at least `min_points` of these points, ascending."""
        return sorted(k for k, n in self._shared(point_ids).items() if n >= min_points)

    def best_connected(self, kf_id: int, count: int) -> list[int]:
        """The `count` keyframes that share most points with this one, best first, ties to the older."""
        shared = self._shared(np.asarray(self._keyframes[kf_id].point_ids))
        shared.pop(kf_id, None)
        return sorted(shared, key=lambda k: (-shared[k], k))[:count]
