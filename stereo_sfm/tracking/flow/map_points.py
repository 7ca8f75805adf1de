"""Updates of the tracked points by the mapper: fused and culled ids, positions."""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64, I64, Bool, MapUpdate


def take_update(tracks: Tracks, update: MapUpdate, resumed_T_odom: F64) -> Tracks:
    """The tracks with fused points under one id, without culled ones, at their positions in the map.

    `resumed_T_odom`: (4, 4) moves these besides.
    """
    tracks = _without_culled(_fused(tracks, update.fused_point_ids), update.culled_point_ids)
    rows, found = rows_of(update.point_ids, tracks.point_ids)
    if len(found):
        to_odom = resumed_T_odom @ se3.inverse(update.map_T_odom)
        _place(tracks, rows, se3.transform(to_odom, update.points_map[found]))
    return tracks


def _fused(tracks: Tracks, pairs: I64) -> Tracks:
    """Ids replaced after fusion, (D, 2) old and new; of tracks with the same id the older one stays."""
    old, first = np.unique(pairs[:, 0], return_index=True)
    if not len(old):
        return tracks
    rows, found = rows_of(old, tracks.point_ids)
    tracks.point_ids[rows] = pairs[first[found], 1]
    _, once = np.unique(tracks.point_ids, return_index=True)
    return tracks.keep(np.isin(np.arange(len(tracks)), once))


def _without_culled(tracks: Tracks, culled: I64) -> Tracks:
    return tracks.keep(~np.isin(tracks.point_ids, culled)) if len(culled) else tracks


def rows_of(ids: I64, wanted: I64) -> tuple[Bool, I64]:
    """Mask (N,) of the wanted ids that are in `ids`, and the rows of those."""
    if not len(ids) or not len(wanted):
        return np.zeros(len(wanted), bool), np.zeros(0, np.int64)
    order = np.argsort(ids, kind="stable")
    at = order[np.clip(np.searchsorted(ids[order], wanted), 0, len(ids) - 1)]
    hit = ids[at] == wanted
    return hit, at[hit]


def _place(tracks: Tracks, rows: Bool, points: F64) -> None:
    """Move tracks to points (M, 3) of the odometry frame, along new rays from their origins."""
    ray = points - tracks.origin[rows]
    distance = np.maximum(np.linalg.norm(ray, axis=1), 1e-6)  # no point is in the camera's centre
    tracks.direction[rows] = ray / distance[:, None]
    tracks.rho[rows] = 1.0 / distance
    tracks.mapped[rows] = True
