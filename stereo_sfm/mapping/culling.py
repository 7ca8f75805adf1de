"""What leaves the map: weak points and redundant keyframes."""

from __future__ import annotations

import numpy as np

from calib.rig import Rig
from stereo_sfm.config import MapperConfig
from stereo_sfm.mapping.map import Map
from stereo_sfm.types import F64, I64, Bool

OTHERS = 3  # keyframes that must see a point before one more is redundant


def weak_points(map_: Map, rig: Rig, rows: I64, newest: int, config: MapperConfig) -> I64:
    """Of some points those that should go.

    A point that the newest keyframe sees stays unless its observations disagree: a far point without parallax still
    tells the tracker how the camera turns. One that is no longer tracked must have been seen by enough keyframes, from
    rays far enough apart.
    """
    points = map_.points
    rows = rows[points.alive[rows]]
    lost = points.last_seen[rows] < newest
    few = lost & (points.obs_count[rows] < config.min_observations)
    error, parallax = _quality(map_, rig, rows)
    bad = (error > config.max_error) & (points.obs_count[rows] >= 2)
    narrow = lost & (parallax < np.deg2rad(config.min_parallax_deg))
    gone = points.obs_count[rows] == 0
    return rows[few | bad | narrow | gone]


def _quality(map_: Map, rig: Rig, rows: I64) -> tuple[F64, F64]:
    """(N,) root mean squared error of the left eyes in sigmas, and (N,) largest angle between a ray and the first."""
    table, points, keyframes = map_.observations, map_.points, map_.keyframes
    obs = map_.observations_of_points(rows)
    order = np.argsort(rows, kind="stable")
    index = order[np.searchsorted(rows[order], table.pt[obs])]
    pose = keyframes.map_T_kf[table.kf[obs]]
    ray = points.xyz[rows][index] - pose[:, :3, 3]
    uv = rig.left.project(np.einsum("nji,nj->ni", pose[:, :3, :3], ray))
    squared = np.nan_to_num(((uv - table.uv_left[obs]) ** 2).sum(1), nan=1e6) / (2 * table.sigma[obs] ** 2)
    count = np.maximum(np.bincount(index, minlength=len(rows)), 1)
    error = np.sqrt(np.bincount(index, squared, len(rows)) / count)
    distance = np.linalg.norm(ray, axis=1)
    unit = ray / np.maximum(distance, 1e-9)[:, None]
    first = np.zeros((len(rows), 3))
    first[index[::-1]] = unit[::-1]
    angle = 2 * np.arcsin(np.clip(np.linalg.norm(unit - first[index], axis=1) / 2, 0, 1))
    both = np.isfinite(table.uv_right[obs, 0])
    angle = np.maximum(angle, np.where(both, rig.baseline / np.maximum(distance, 1e-9), 0))
    parallax = np.zeros(len(rows))
    np.maximum.at(parallax, index, angle)
    return error, parallax


def redundant_keyframe(map_: Map, newest: int, protected: Bool, config: MapperConfig) -> int:
    """A neighbour of the newest keyframe whose points are seen well enough without it, -1: none. Oldest first.

    Args:
        protected: (K,) keyframes that must stay (the first, those of loops, the newest ones).
    """
    if config.redundant_share > 1:
        return -1
    neighbours, _ = map_.covisibility.neighbours(newest, config.connected_points)
    for row in np.sort(neighbours):
        if protected[row]:
            continue
        pts = map_.observations.pt[map_.observations_of_keyframe(int(row))]
        if len(pts) and (map_.points.obs_count[pts] > OTHERS).mean() > config.redundant_share:
            return int(row)
    return -1
