"""Points of the last keyframes with descriptors, for matching in the monocular tracker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.papers.extraction import Features
from stereo_sfm.papers.feature_view import FeatureView
from stereo_sfm.papers.point_ids import PointIds
from stereo_sfm.tracking.flow.map_points import rows_of
from stereo_sfm.types import F32, F64, I64, U8, MapUpdate


@dataclass
class LocalPoints:
    """One row per point, the newest last."""

    ids: I64  # (N,)
    points: F64  # (N, 3) odometry frame
    descriptors: U8 | F32  # (N, D)
    limit: int = 4000

    def add(self, view: FeatureView, odom_T_cam: F64) -> None:
        """Take a keyframe's points; what is known already gets its newest descriptor and position."""
        rows = np.isfinite(view.points[:, 2]) & (view.ids >= 0)
        stays = ~np.isin(self.ids, view.ids[rows])
        self.ids = np.concatenate([self.ids[stays], view.ids[rows]])[-self.limit :]
        points = se3.transform(odom_T_cam, view.points[rows])
        self.points = np.concatenate([self.points[stays], points])[-self.limit :]
        both = np.concatenate([self.descriptors[stays], view.features.descriptors[rows]])[-self.limit :]
        self.descriptors = cast("U8 | F32", both)

    def apply(self, update: MapUpdate, ids: PointIds) -> None:
        """Positions from the map; points that it culled or fused away go."""
        known = ids.current(self.ids)
        _, first = np.unique(known, return_index=True)
        keep = np.zeros(len(known), bool)
        keep[first] = True
        keep &= ~np.isin(known, update.culled_point_ids)
        self.ids, self.points, self.descriptors = known[keep], self.points[keep].copy(), self.descriptors[keep]
        hit, rows = rows_of(update.point_ids, self.ids)
        self.points[hit] = se3.transform(se3.inverse(update.map_T_odom), update.points_map[rows])

    def positions(self, ids: I64) -> F64:
        """(M, 3) of given ids in the odometry frame, NaN where unknown."""
        out, (hit, rows) = np.full((len(ids), 3), np.nan), rows_of(self.ids, ids)
        out[hit] = self.points[rows]
        return out

    def features(self, rows: I64) -> Features:
        """Some rows as features for matching; their pixels mean nothing."""
        return Features(np.zeros((len(rows), 2)), self.descriptors[rows])
