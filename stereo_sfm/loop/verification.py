"""Geometric verification: does this camera really see the place of that keyframe, and from where?

Descriptors propose pairs; a pose from bearings and stereo points in both directions decides; the map around the
candidate is then projected with that pose to find the pairs that the first matching missed.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.rig import Rig
from stereo_sfm.config import LoopConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.loop import binary
from stereo_sfm.loop.absolute_pose import Matches, Pose, ransac_pose, refine_pose
from stereo_sfm.loop.cloud import Cloud
from stereo_sfm.mapping.bundle import Bundle, bundle_adjust
from stereo_sfm.types import F64, I32, I64, Keyframe

GUIDED_RADII_PX = 12.0, 6.0  # one round each
GRID = (8, 6)  # columns, rows


@dataclass(frozen=True, eq=False)
class View:
    """What is seen by the camera to place: all points with a descriptor; NaN points where no depth is known."""

    ids: I64  # (N,)
    uv_left: F64  # (N, 2)
    uv_right: F64  # (N, 2)
    points: F64  # (N, 3) in this camera
    sigmas: F64  # (N,)
    words: binary.U64  # (N, 4) descriptors
    descriptors: Any  # (N, 32) uint8


@dataclass(frozen=True, eq=False)
class Verdict:
    """The answer for one candidate."""

    reason: str  # "" when the place is confirmed
    b_T_a: F64  # (4, 4) from the candidate's frame into the camera's
    information: F64  # (6, 6)
    pairs: I64  # (M, 2) point ids: candidate's, camera's
    inliers: int


def view_of(keyframe: Keyframe, sigmas: F64) -> View:
    """Rows of a keyframe that have a descriptor; `sigmas` (N,) range uncertainty of its points."""
    rows = np.flatnonzero(binary.present(keyframe.descriptors))
    return View(
        keyframe.point_ids[rows],
        np.ascontiguousarray(keyframe.uv_left[rows]),
        keyframe.uv_right[rows],
        np.ascontiguousarray(keyframe.points_cam[rows]),
        sigmas[rows],
        binary.as_words(keyframe.descriptors[rows]),
        keyframe.descriptors[rows],
    )


def rejection(reason: str, inliers: int = 0) -> Verdict:
    """A verdict against."""
    return Verdict(reason, np.eye(4), np.zeros((6, 6)), np.zeros((0, 2), np.int64), inliers)


def verify(
    view: View, cloud: Cloud, rig: Rig, config: LoopConfig, rng: np.random.Generator, move_points: bool = True
) -> Verdict:
    """Match, place, match again along the projection, and judge. See the reasons below for what is asked for.

    Args:
        move_points: finish with a bundle that moves the points too (stereo points are noisy, those of a map are not).
    """
    rows_b, rows_a, _ = binary.match_descriptors(
        view.descriptors, cloud.descriptors, cloud.ids, config.max_distance, config.match_ratio
    )
    if len(rows_b) < max(config.min_match_fraction * len(view.ids), 4):
        return rejection("too_few_matches", len(rows_b))
    pose = _place(view, cloud, rows_b, rows_a, rig, config, rng)
    if pose is None:
        return rejection("no_pose")
    if pose.inlier.sum() < config.min_inliers // 2:
        return rejection("too_few_inliers", int(pose.inlier.sum()))
    return verify_near(pose.b_T_a, view, cloud, rig, config, move_points)


def verify_near(
    b_T_a: F64, view: View, cloud: Cloud, rig: Rig, config: LoopConfig, move_points: bool = False
) -> Verdict:
    """The second half of `verify`: from a pose that is nearly right."""
    pose: Pose | None = None
    rows_b = rows_a = np.zeros(0, np.int32)
    for radius in GUIDED_RADII_PX:
        rows_b, rows_a = match_guided(b_T_a, view, cloud, rig, config.max_distance, radius)
        if len(rows_b) < 4:
            return rejection("too_few_inliers", len(rows_b))
        pose = refine_pose(b_T_a, _pair(view, cloud, rows_b, rows_a), rig, config.pixel_sigma)
        b_T_a = pose.b_T_a
    assert pose is not None
    inliers = int(pose.inlier.sum())
    if inliers < max(config.min_inliers, config.min_inlier_share * len(view.ids)):
        return rejection("too_few_inliers", inliers)
    rows_a, rows_b = rows_a[pose.inlier], rows_b[pose.inlier]
    if occupied_cells(view.uv_left[rows_b], rig.left.size) < config.min_cells:
        return rejection("not_spread", inliers)
    if move_points:
        b_T_a = refine_with_points(b_T_a, view, cloud, rows_b, rows_a, rig, config)
    return Verdict("", b_T_a, pose.information, np.stack([cloud.ids[rows_a], view.ids[rows_b]], axis=1), inliers)


def _place(
    view: View, cloud: Cloud, rows_b: I32, rows_a: I32, rig: Rig, config: LoopConfig, rng: np.random.Generator
) -> Pose | None:
    matches = _pair(view, cloud, rows_b, rows_a)
    start = ransac_pose(matches, rig, rng, config.pixel_sigma, config.ransac_iterations)
    return None if start is None else refine_pose(start, matches, rig, config.pixel_sigma)


def refine_with_points(
    b_T_a: F64, view: View, cloud: Cloud, rows_b: I32, rows_a: I32, rig: Rig, config: LoopConfig
) -> F64:
    """b_T_a from a bundle over all views of the matched points, the candidate's side held fast.

    The retail paper finds the loop's pose this way (section IV-C3). Moving the points with it removes the bias that
    noisy stereo depth has on a pose from fixed points.
    """
    ids = np.unique(cloud.ids[rows_a])
    views = np.flatnonzero(np.isin(cloud.ids, ids))
    first = views[np.unique(cloud.ids[views], return_index=True)[1]]
    obs_pt = np.searchsorted(ids, np.concatenate([cloud.ids[views], cloud.ids[rows_a]]))
    camera = len(cloud.centre_T_kf)
    bundle = Bundle(
        world_T_kf=np.concatenate([cloud.centre_T_kf, se3.inverse(b_T_a)[None]]),
        fixed=np.arange(camera + 1) < camera,
        points=cloud.points[first],
        obs_kf=np.concatenate([cloud.view[views], np.full(len(rows_b), camera)]),
        obs_pt=obs_pt,
        uv_left=np.concatenate([cloud.uv_left[views], view.uv_left[rows_b]]),
        uv_right=np.concatenate([cloud.uv_right[views], view.uv_right[rows_b]]),
        sigma=np.full((len(obs_pt), 2), config.disparity_sigma),
    )
    return se3.inverse(bundle_adjust(rig, bundle).world_T_kf[-1])


def _pair(view: View, cloud: Cloud, rows_b: I32, rows_a: I32) -> Matches:
    left_a, right_a = cloud.seen_by_centre(rows_a)
    return Matches(
        cloud.points[rows_a],
        cloud.sigmas[rows_a],
        view.uv_left[rows_b],
        view.uv_right[rows_b],
        view.points[rows_b],
        view.sigmas[rows_b],
        left_a,
        right_a,
    )


def match_guided(b_T_a: F64, view: View, cloud: Cloud, rig: Rig, max_distance: int, radius: float) -> tuple[I32, I32]:
    """Pairs (rows of view, rows of cloud) whose descriptors agree within `radius` px of the projection, one to one."""
    uv = rig.left.project(se3.transform(b_T_a, cloud.points))
    best = _nearest_within(view.uv_left, view.words, uv, binary.as_words(cloud.descriptors), radius, max_distance)
    rows_b = np.flatnonzero(best >= 0).astype(np.int32)
    return rows_b, best[rows_b]


@njit
def _nearest_within(uv_b, words_b, uv_a, words_a, radius, max_distance):
    """For every row of b the row of a with the nearest descriptor within the radius, if b is also its nearest."""
    n, m = uv_b.shape[0], uv_a.shape[0]
    best = np.full(n, -1, np.int32)
    low = np.full(n, max_distance + 1, np.int32)
    best_a = np.full(m, -1, np.int32)
    low_a = np.full(m, max_distance + 1, np.int32)
    for j in range(m):
        if not np.isfinite(uv_a[j, 0]):
            continue
        for i in range(n):
            if abs(uv_b[i, 0] - uv_a[j, 0]) > radius or abs(uv_b[i, 1] - uv_a[j, 1]) > radius:
                continue
            d = binary.hamming(words_b, i, words_a, j)
            if d < low[i]:
                low[i] = d
                best[i] = j
            if d < low_a[j]:
                low_a[j] = d
                best_a[j] = i
    for i in range(n):
        if best[i] >= 0 and best_a[best[i]] != i:
            best[i] = -1
    return best


def occupied_cells(uv: F64, size: tuple[int, int]) -> int:
    """How many cells of an 8 x 6 grid over the image hold a point."""
    column = np.clip((uv[:, 0] * GRID[0] / size[0]).astype(int), 0, GRID[0] - 1)
    row = np.clip((uv[:, 1] * GRID[1] / size[1]).astype(int), 0, GRID[1] - 1)
    return len(np.unique(row * GRID[0] + column))


def within(error: F64, metres: float, degrees: float) -> bool:
    """Whether a transform (4, 4) moves by at most so much."""
    moved, turned = se3.extent(error)
    return bool(moved <= metres and np.rad2deg(turned) <= degrees)
