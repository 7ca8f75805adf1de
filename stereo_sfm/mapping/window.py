"""Parts of the map as bundles: the covisible window around a keyframe, or the whole map.

A point that only one keyframe observes constrains no pose: it is left out of the bundle and moves with its keyframe.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.imu import Imu
from stereo_sfm.config import MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.bundle import Bundle, BundleConfig, BundleResult
from stereo_sfm.mapping.level import level_of
from stereo_sfm.mapping.map import POSE_POINTS, Map
from stereo_sfm.mapping.motion_factors import motion_factors
from stereo_sfm.types import F64, I64, Bool


@dataclass(frozen=True, eq=False)
class Window:
    """A bundle and the rows of the map that it contains."""

    bundle: Bundle
    kf_rows: I64  # (K,) keyframe rows, the moving ones first
    pt_rows: I64  # (P,)
    obs_rows: I64  # (M,)


def bundle_config(config: MapperConfig) -> BundleConfig:
    """The mapper's settings of bundle adjustment."""
    return BundleConfig(
        iterations=config.iterations,
        huber=config.huber_sigmas,
        cauchy=config.cauchy_medians,
        disparity_sigmas=config.disparity_sigmas,
        fixed_once=True,
    )


def final_bundle_config(config: MapperConfig) -> BundleConfig:
    """Those of the last full bundle adjustment.

    It converges, also in the weights, for which it has twice as many rounds, and in the scale, which is slow. With one
    loss over both images: where a match disagrees, because its window shows two surfaces, the pixel of the left image
    is no better. (During the run the right images may all disagree for a while, after a step of the rig, and the left
    ones hold the map together.)
    """
    usual = bundle_config(config)
    return dataclasses.replace(
        usual, rounds=2 * usual.rounds, iterations=config.final_iterations, joint_loss=True, extend=True
    )


def covisible_window(map_: Map, row: int, config: MapperConfig, imu: Imu | None = None) -> Window:
    """The keyframe, those that share most points with it, and all their points; other keyframes are fixed.

    The map's first keyframe is fixed, and so is the oldest keyframe of a part that no fixed keyframe is connected to.
    The bundle has what the map knows of the motions between the keyframes (`motions.Motion`).
    """
    others = map_.neighbours(row, config.connected_points)
    if not len(others):
        others = map_.neighbours(row)
    part = _window(map_, np.concatenate([[row], others])[: config.most_keyframes].astype(np.int64), config.most_fixed)
    return _with_motions(part, map_, imu)


def newest(map_: Map, first_row: int, most: int, config: MapperConfig, imu: Imu | None = None) -> Window:
    """The newest living keyframes, `most` of them and none before a row, and all their points; others are fixed.

    With motions as `covisible_window`.
    """
    rows = map_.living_keyframes()
    return _with_motions(_window(map_, rows[rows >= first_row][-most:], config.most_fixed), map_, imu)


def whole_map(map_: Map) -> Window:
    """Every living keyframe and point; of each unconnected part the oldest keyframe is fixed."""
    return _window(map_, map_.living_keyframes())


def _with_motions(part: Window, map_: Map, imu: Imu | None) -> Window:
    """The motions between its keyframes."""
    motions = motion_factors(map_, part.kf_rows, part.bundle.fixed, imu)
    return dataclasses.replace(part, bundle=dataclasses.replace(part.bundle, motions=motions))


def _window(map_: Map, moving: I64, most_fixed: int | None = None) -> Window:
    table, points = map_.observations, map_.points
    pts = map_.points_of_keyframes(moving)
    pts = pts[points.alive[pts] & np.isfinite(points.xyz[pts, 0]) & (points.obs_count[pts] > 1)]
    obs, obs_pt = map_.sightings(pts)
    seeing = map_.made_by(obs)
    held = np.sort(seeing[~np.isin(seeing, moving)][:most_fixed])
    kfs = np.concatenate([np.sort(moving), held])
    fixed = np.arange(len(kfs)) >= len(moving)
    fixed |= kfs == 0
    kf_index = np.full(len(map_.keyframes), -1, np.int64)
    kf_index[kfs] = np.arange(len(kfs))
    inside = kf_index[table.kf[obs]] >= 0
    obs, obs_pt = obs[inside], obs_pt[inside]
    fixed[_floating(map_, kfs, fixed)] = True
    uv_left, uv_right, sigma = (column[obs].astype(float) for column in (table.uv_left, table.uv_right, table.sigma))
    bundle = Bundle(
        map_.keyframes.map_T_kf[kfs], fixed, points.xyz[pts], kf_index[table.kf[obs]], obs_pt, uv_left, uv_right,
        np.repeat(sigma[:, None], 2, 1), level_of(map_, kfs, fixed),
    )  # fmt: skip
    return Window(bundle, kfs, pts, obs)


def _floating(map_: Map, kfs: I64, fixed: Bool) -> I64:
    """The oldest keyframe (index) of every part that too few shared points connect with a fixed keyframe.

    A part is followed no further than to the first keyframe that is held: few keyframes' neighbours are counted.
    """
    index = np.full(len(map_.keyframes), -1, np.int64)
    index[kfs] = np.arange(len(kfs))
    held, oldest = fixed.copy(), list[int]()
    for first in np.flatnonzero(~fixed)[::-1].tolist():
        part, ends, loose = {first}, [first], not held[first]
        while loose and ends:
            linked = index[map_.neighbours(int(kfs[ends.pop()]), POSE_POINTS)]
            linked = linked[linked >= 0]
            loose = not held[linked].any()
            ends += [i for i in linked.tolist() if i not in part]
            part.update(linked.tolist())
        held[list(part)] = True
        if loose:
            oldest.append(min(part, key=lambda i: int(kfs[i])))
    return np.array(oldest, np.int64)


def write_back(map_: Map, part: Window, result: BundleResult) -> None:
    """Write poses and points of living rows into the map; observations of images that disagree are removed."""
    moved = np.flatnonzero(~part.bundle.fixed & map_.keyframes.alive[part.kf_rows])
    _carry_single_points(map_, part.kf_rows[moved], result.world_T_kf[moved])
    map_.move_keyframes(part.kf_rows[moved], result.world_T_kf[moved])
    if part.bundle.motions is not None and result.states is not None:
        inside = part.bundle.motions.rows
        own = np.flatnonzero((inside >= 0) & ~part.bundle.fixed[inside])
        map_.keyframes.state[part.kf_rows[inside[own]]] = result.states[own]
    alive = map_.points.alive[part.pt_rows]
    map_.move_points(part.pt_rows[alive], result.points[alive])
    table, obs = map_.observations, part.obs_rows
    wrong_left = ~result.inlier[:, 0] & np.isfinite(part.bundle.uv_left[:, 0])
    wrong_right = ~result.inlier[:, 1] & np.isfinite(part.bundle.uv_right[:, 0])
    table.uv_right[obs[wrong_right & ~wrong_left]] = np.nan
    map_.remove_observations(obs[wrong_left])


def _carry_single_points(map_: Map, kf_rows: I64, after: F64) -> None:
    """Points that only one of these keyframes observes move with it."""
    points = map_.points
    for row, pose in zip(kf_rows.tolist(), after, strict=True):
        seen = map_.seen_by(row)
        seen = seen[(points.obs_count[seen] == 1) & np.isfinite(points.xyz[seen, 0])]
        move = pose @ se3.inverse(map_.keyframes.map_T_kf[row])
        map_.move_points(seen, se3.transform(move, points.xyz[seen]))
