"""Insertion of a keyframe: association of its points with the map, its pose, and new points."""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.association import find_again
from stereo_sfm.mapping.bundle import adjust_pose
from stereo_sfm.mapping.map import POSE_POINTS, Map
from stereo_sfm.mapping.motions import Motion
from stereo_sfm.types import F64, I64, Bool, Keyframe


def insert_keyframe(
    map_: Map, rig: Rig, keyframe: Keyframe, guess: F64, config: MapperConfig
) -> tuple[int, list[tuple[int, int]]]:
    """Insert a keyframe with its points.

    Args:
        guess: (4, 4) map_T_kf by odometry.

    Returns:
        Its row, and rows of fused points (removed, the one that replaced it).
    """
    rows, usable = _identify(map_, keyframe, config)
    pose, agreeing = _solve_pose(map_, rig, keyframe, rows, usable & (rows >= 0), guess, config)
    # Odometry, which has all tracked points, knows the pose better than few points of the map.
    few = keyframe.odometry is not None and agreeing < 2 * config.connected_points
    pose = guess if few else pose
    row = map_.add_keyframe(keyframe, pose, Motion.of(keyframe, rig.imu, config.sensors, few))
    matches = np.zeros((0, 2), np.int64)
    if config.association == "map":
        matches = find_again(map_, rig, keyframe, rows, usable, pose, config)
    new = np.flatnonzero(usable & (rows < 0))
    xyz = se3.transform(pose, keyframe.points_cam[new])
    rows[new] = map_.add_points(keyframe.point_ids[new], xyz, row, config.sigma_px)
    fused = [pair for i, known in matches.tolist() if (pair := fuse_points(map_, int(rows[i]), known, config))]
    rows = map_.point_rows(keyframe.point_ids)
    each, first = np.unique(np.where(usable, rows, -1), return_index=True)
    keep = np.sort(first[each >= 0])  # one observation of a point
    map_.observe(row, rows[keep], keyframe.uv_left[keep], keyframe.uv_right[keep], keyframe.descriptors[keep])
    return row, fused


def _identify(map_: Map, keyframe: Keyframe, config: MapperConfig) -> tuple[I64, Bool]:
    """(N,) point row of each track, -1 if new, and (N,) which may be used: tracks of culled points may not."""
    rows = map_.point_rows(keyframe.point_ids)
    usable = (rows < 0) | map_.points.alive[np.maximum(rows, 0)] if len(map_.points) else np.ones(len(rows), bool)
    usable &= np.isfinite(keyframe.uv_left).all(axis=1)
    if config.association == "previous" and len(map_.keyframes):
        before = map_.observations.pt[map_.observations_of_keyframe(len(map_.keyframes) - 1)]
        usable &= (rows < 0) | np.isin(rows, before)
    return rows, usable


def _solve_pose(
    map_: Map, rig: Rig, keyframe: Keyframe, rows: I64, known: Bool, guess: F64, config: MapperConfig
) -> tuple[F64, int]:
    """(4, 4) map_T_kf from the known points, and how many agree; the guess and 0 if there are too few."""
    known = known.copy()
    known[known] = np.isfinite(map_.points.xyz[rows[known], 0])
    count = int(known.sum())
    if count < POSE_POINTS:
        return guess, 0
    rows = rows[known]
    points, uv_left, uv_right = map_.points, keyframe.uv_left[known], keyframe.uv_right[known]
    sigma = points.sigma[rows].astype(float)
    pose, inlier = adjust_pose(rig, guess, points.xyz[rows], uv_left, uv_right, sigma, config.huber_sigmas)
    if inlier[:, 0].sum() < max(POSE_POINTS, count // 2):
        return guess, 0
    return pose, int(np.count_nonzero(inlier[:, 0] & (inlier[:, 1] | ~np.isfinite(uv_right[:, 0]))))


def fuse_points(map_: Map, first: int, second: int, config: MapperConfig) -> tuple[int, int] | None:
    """Fuse two points, the older is kept; not if one keyframe saw both. Returns (removed, kept) or None."""
    removed, kept = max(first, second), min(first, second)
    if removed == kept or not (map_.points.alive[removed] and map_.points.alive[kept]):
        return None
    if map_.share_a_keyframe(removed, kept):
        return None
    map_.fuse(removed, kept, config.match_sigma_px)
    return removed, kept
