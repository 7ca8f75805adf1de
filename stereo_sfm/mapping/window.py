"""Parts of the map as bundles: the covisible window around a keyframe, or everything."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from stereo_sfm.config import MapperConfig
from stereo_sfm.mapping.bundle import Bundle, BundleConfig, BundleResult
from stereo_sfm.mapping.map import Map
from stereo_sfm.types import I64, Bool

ALL_KEYFRAMES = 10**9


@dataclass(frozen=True, eq=False)
class Window:
    """A bundle and where its rows came from."""

    bundle: Bundle
    kf_rows: I64  # (K,) keyframe rows, those that may move first
    moving: int  # how many of them may move
    pt_rows: I64  # (P,)
    obs_rows: I64  # (M,)


def bundle_config(config: MapperConfig) -> BundleConfig:
    """How the mapper adjusts its windows."""
    return BundleConfig(rounds=config.rounds, iterations=config.iterations, huber=config.huber)


def covisible_window(map_: Map, row: int, config: MapperConfig) -> Window:
    """The keyframe, those that share most points with it, and the points of all of them; the rest is fixed.

    The map's first keyframe never moves, nor does the oldest keyframe of a part that nothing fixed is connected to.
    """
    others, _ = map_.covisibility.neighbours(row, config.connected_points)
    if not len(others):
        others, _ = map_.covisibility.neighbours(row)
    limit = config.window_keyframes - 1 if config.window_keyframes > 0 else ALL_KEYFRAMES
    return _window(map_, np.concatenate([[row], others[:limit]]).astype(np.int64), config)


def whole_map(map_: Map, config: MapperConfig) -> Window:
    """Every living keyframe and point; of each unconnected part the oldest keyframe is fixed."""
    return _window(map_, map_.living_keyframes(), config)


def _window(map_: Map, moving: I64, config: MapperConfig) -> Window:
    table, points = map_.observations, map_.points
    seen = np.concatenate([table.pt[map_.observations_of_keyframe(int(k))] for k in moving])
    pts = np.unique(seen).astype(np.int64)
    pts = pts[points.alive[pts] & np.isfinite(points.xyz[pts, 0])]
    obs = map_.observations_of_points(pts)
    around = np.setdiff1d(table.kf[obs], moving)
    moving = np.sort(moving)
    kfs = np.concatenate([moving, around]).astype(np.int64)
    fixed = np.arange(len(kfs)) >= len(moving)
    fixed |= kfs == 0
    kf_index = np.full(len(map_.keyframes), -1, np.int64)
    kf_index[kfs] = np.arange(len(kfs))
    obs_kf, obs_pt = kf_index[table.kf[obs]], np.searchsorted(pts, table.pt[obs])
    fixed[_floating(fixed, obs_kf, obs_pt, len(pts))] = True
    bundle = Bundle(
        map_.keyframes.map_T_kf[kfs],
        fixed,
        points.xyz[pts],
        obs_kf,
        obs_pt,
        table.uv_left[obs].astype(float),
        table.uv_right[obs].astype(float),
        np.repeat(table.sigma[obs].astype(float)[:, None], 2, 1),
    )
    return Window(bundle, kfs, len(moving), pts, obs)


def _floating(fixed: Bool, obs_kf: I64, obs_pt: I64, points: int) -> I64:
    """The oldest keyframe of every component that points do not connect to a fixed keyframe: it must not drift."""
    count = len(fixed)
    size = count + points
    edges = scipy.sparse.csr_array((np.ones(len(obs_kf), np.int8), (obs_kf, count + obs_pt)), shape=(size, size))
    label = connected_components(edges, directed=False)[1][:count]
    floating = np.flatnonzero(~np.isin(label, label[fixed]))
    _, oldest = np.unique(label[floating], return_index=True)
    return floating[oldest]


def write_back(map_: Map, part: Window, result: BundleResult) -> None:
    """New poses and points of what still lives; eyes that disagree lose their observation."""
    moved = np.flatnonzero(~part.bundle.fixed & map_.keyframes.alive[part.kf_rows])
    map_.move_keyframes(part.kf_rows[moved], result.world_T_kf[moved])
    sane = np.isfinite(result.points).all(axis=1) & map_.points.alive[part.pt_rows]
    map_.move_points(part.pt_rows[sane], result.points[sane])
    table, obs = map_.observations, part.obs_rows
    wrong_left = ~result.inlier[:, 0] & np.isfinite(part.bundle.uv_left[:, 0])
    wrong_right = ~result.inlier[:, 1] & np.isfinite(part.bundle.uv_right[:, 0])
    table.uv_right[obs[wrong_right & ~wrong_left]] = np.nan
    map_.remove_observations(obs[wrong_left])
