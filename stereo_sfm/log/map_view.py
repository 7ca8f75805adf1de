"""The map as the log shows it: keyframe poses, points and edges, assembled from the messages of a run."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from stereo_sfm.mapping.keyframe_poses import KeyframePoses
from stereo_sfm.types import F64, I64, Keyframe, LoopResult, MapUpdate

COVISIBLE_KEYFRAMES = 20  # how far back edges are looked for
COVISIBLE_POINTS = 30  # shared points that make an edge


class MapView:
    """Follows the mapper's updates. Points are columns sorted by id."""

    def __init__(self) -> None:
        self.point_ids: I64 = np.zeros(0, np.int64)
        self.points: F64 = np.zeros((0, 3))
        self._poses = KeyframePoses()
        self._recent: list[tuple[int, I64]] = []  # keyframes: id, and those of the points that they see
        self._covisible: list[tuple[int, int]] = []
        self._loops: list[tuple[int, int]] = []
        self._refused: set[int] = set()  # kf_ids whose loops the mapper rejected

    def keyframe(self, keyframe: Keyframe, map_T_odom: F64) -> None:
        """A new keyframe, at its odometry pose until the mapper moves it."""
        self._poses.add(keyframe.kf_id, map_T_odom @ keyframe.odom_T_cam)
        if self._recent:
            ids, points = zip(*self._recent, strict=True)
            seen = np.isin(np.concatenate(points), keyframe.point_ids)
            shared = np.bincount(np.repeat(np.arange(len(ids)), [len(p) for p in points]), seen, len(ids))
            self._covisible += [(ids[k], keyframe.kf_id) for k in np.flatnonzero(shared >= COVISIBLE_POINTS).tolist()]
        self._recent = [*self._recent[1 - COVISIBLE_KEYFRAMES :], (keyframe.kf_id, keyframe.point_ids)]

    def loop(self, result: LoopResult) -> None:
        """A result of the loop closer."""
        if result.candidate_kf_id >= 0 and not result.reason:
            self._loops.append((result.candidate_kf_id, result.kf_id))

    def update(self, update: MapUpdate) -> None:
        """The mapper's new poses and points."""
        self._poses.update(update)
        self._refused.update(update.refused_kf_ids.tolist())
        gone = np.concatenate([update.culled_point_ids, update.fused_point_ids[:, 0], update.point_ids])
        keep = ~np.isin(self.point_ids, gone)
        ids = np.concatenate([self.point_ids[keep], update.point_ids])
        points = np.concatenate([self.points[keep], update.points_map])
        order = np.argsort(ids, kind="stable")
        self.point_ids, self.points = ids[order], points[order]

    @property
    def keyframes(self) -> int:
        """How many there are."""
        return len(self._poses)

    @property
    def trajectory(self) -> tuple[I64, F64]:
        """(K,) ids, ascending, and (K, 4, 4) map_T_kf of all keyframes."""
        poses = self._poses.all()
        return np.array(list(poses), np.int64), np.array(list(poses.values())).reshape(-1, 4, 4)

    @property
    def covisibility_lines(self) -> F64:
        """(2E, 3) ends of the edges between living keyframes that see the same points."""
        self._covisible = [(i, j) for i, j in self._covisible if self._poses.lives(i) and self._poses.lives(j)]
        return self._lines(self._covisible)

    @property
    def loop_lines(self) -> F64:
        """(2E, 3) ends of the accepted loops."""
        return self._lines((i, j) for i, j in self._loops if j not in self._refused)

    def _lines(self, edges: Iterable[tuple[int, int]]) -> F64:
        poses = self._poses.all()
        known = [(i, j) for i, j in edges if i in poses and j in poses]
        return np.array([poses[k][:3, 3] for edge in known for k in edge]).reshape(-1, 3)
