"""Insertion of a keyframe: association of its points with the map, its pose, and new points.

Points that no track connects with the map are matched by projection. Candidates are points of keyframes that share
points with this one, of their neighbours, and of nearby keyframes. A match must be near its projection in both images,
have similar descriptors, and be mutually best; all matches together must agree with one pose.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.hamming import as_words
from stereo_sfm.mapping import map_kernels
from stereo_sfm.mapping.bundle import adjust_pose
from stereo_sfm.mapping.culling import OF_A_VIEW, SAME_VIEW_DEPTHS
from stereo_sfm.mapping.map import POSE_POINTS, Map
from stereo_sfm.mapping.motions import Motion
from stereo_sfm.types import F64, I64, Bool, Keyframe

ALIKE_COS = 0.8  # cosine of 37 degrees, up to which a view of a point looks like the first


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
        matches = _find_again(map_, rig, keyframe, rows, usable, pose, config)
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


def _find_again(
    map_: Map, rig: Rig, keyframe: Keyframe, rows: I64, usable: Bool, pose: F64, config: MapperConfig
) -> I64:
    """Points of the map that a keyframe sees again: (M, 2) its rows and those of the points.

    Args:
        rows: (N,) point row of each of its tracks, -1 if new. usable: (N,). pose: (4, 4) map_T_kf.
    """
    tracked = rows[usable & (rows >= 0)]
    depth = np.linalg.norm(keyframe.points_cam, axis=1)
    reach = 2 * SAME_VIEW_DEPTHS * float(np.nanmedian(depth)) if np.isfinite(depth).any() else 0.0
    around = _local_keyframes(map_, tracked, pose, reach, config)
    points, left, right = _points_in_view(map_, rig, around, pose)
    followed = np.zeros(len(map_.points), bool)
    followed[tracked] = True
    other = ~followed[points]
    followed[points] = True
    map_.points.expected[followed] += 1
    points = points[other]
    words = as_words(np.where(usable[:, None], keyframe.descriptors, 0).astype(np.uint8))
    pairs = map_kernels.match_near(
        keyframe.uv_left, keyframe.uv_right, words, left[other], right[other], as_words(map_.descriptors_of(points)),
        config.match_radius_px, config.match_distance_bits, config.match_ratio,
    )  # fmt: skip
    mine = np.flatnonzero(pairs >= 0)
    points = points[pairs[mine]]
    good = _agreeing(rig, pose, map_.points.xyz[points], keyframe.uv_left[mine], keyframe.uv_right[mine], config)
    return np.stack([mine[good], points[good]], 1)


def _local_keyframes(map_: Map, seen_points: I64, map_T_kf: F64, reach: float, config: MapperConfig) -> I64:
    """Rows of keyframes whose points may be in view.

    Args:
        seen_points: rows of points that the new keyframe observes.
        reach: metres; keyframes closer than that whose optical axes differ by less than 60 degrees are neighbours.
    """
    first = map_.made_by(map_.sightings(seen_points)[0])[: config.most_keyframes]
    second = [map_.neighbours(int(k), config.connected_points)[:5] for k in first]
    alive = map_.living_keyframes()
    pose = map_.keyframes.map_T_kf[alive]
    metres = np.linalg.norm(pose[:, :3, 3] - map_T_kf[:3, 3], axis=1)
    near = np.flatnonzero((metres < reach) & (pose[:, :3, 2] @ map_T_kf[:3, 2] > 0.5))
    near = alive[near[np.argsort(metres[near], kind="stable")]][: 2 * OF_A_VIEW]
    return np.unique(np.concatenate([first, *second, near]).astype(np.int64))


def _points_in_view(map_: Map, rig: Rig, keyframes: I64, map_T_kf: F64) -> tuple[I64, F64, F64]:
    """Points of keyframes visible from this pose: rows, left and right px or NaN.

    From less than half or more than twice the distance at which it was seen first, or another side, a point looks
    otherwise.
    """
    points = map_.points
    rows = map_.points_of_keyframes(keyframes)
    rows = rows[points.alive[rows] & np.isfinite(points.xyz[rows, 0])]
    xyz = points.xyz[rows]
    then, now = xyz - map_.keyframes.map_T_kf[points.anchor[rows], :3, 3], xyz - map_T_kf[:3, 3]
    far, near = np.linalg.norm(then, axis=1), np.linalg.norm(now, axis=1)
    alike = (near < 2 * far) & (far < 2 * near) & ((then * now).sum(axis=1) > ALIKE_COS * far * near)
    rows, in_left = rows[alike], se3.transform(se3.inverse(map_T_kf), xyz[alike])
    uv_left = rig.left.project(in_left)
    visible = rig.left.inside(uv_left, 2.0)
    uv_left, in_left = uv_left[visible], in_left[visible]
    return rows[visible], uv_left, np.full_like(uv_left, np.nan) if rig.right is None else rig.project_right(in_left)


def _agreeing(rig: Rig, map_T_kf: F64, xyz: F64, uv_left: F64, uv_right: F64, config: MapperConfig) -> Bool:
    """Which matches (N,) agree with one pose near the given one; none if too few do."""
    count = len(xyz)
    none = np.zeros(count, bool)
    if count < config.match_min:
        return none
    sigma, huber = np.full(count, config.match_sigma_px), 2 * config.huber_sigmas  # without the bias of tracks at edges
    _, inlier = adjust_pose(rig, map_T_kf, xyz, uv_left, uv_right, sigma, huber)
    good = inlier[:, 0] & (inlier[:, 1] | ~np.isfinite(uv_right[:, 0]))
    return good if good.sum() >= max(config.match_min, 0.5 * count) else none
