"""Geometric verification of a loop candidate, and the relative pose.

Descriptor matches give a pose from bearings and stereo points in both directions (RANSAC); the points around the
candidate are then projected with that pose to find the matches that the first matching missed.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import LoopConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop import binary
from stereo_sfm.loop.absolute_pose import Matches, Pose, consistent, ransac_pose, refine_pose
from stereo_sfm.loop.cloud import Cloud, match_guided
from stereo_sfm.loop.place_view import PlaceView
from stereo_sfm.mapping.bundle import Bundle, BundleConfig, bundle_adjust
from stereo_sfm.tracking.flow.visible_area import cells_of
from stereo_sfm.types import F64, I64, Keyframe

GUIDED = (12.0, 4), (6.0, 10)  # rounds of guided matching: radius of the search in px, maximum of iterations
FIRST_SHARE = 0.4  # of the required inliers that the pose from three points must have: guided matching finds more
CONFIDENT_SHARE = 0.4  # of the corners ahead and beside; places that only look alike have 0.3 at most


@dataclass(frozen=True, eq=False)
class Verdict:
    """The result for one candidate."""

    reason: str  # of the rejection, "" if the place is confirmed
    b_T_a: F64  # (4, 4) from the candidate's frame into the camera's
    information: F64  # (6, 6)
    pairs: I64  # (M, 2) point ids: candidate's, camera's; corners that are not map points are left out
    inliers: int  # corners that agree with the pose
    share: float  # of the camera's corners that are inliers
    rows: I64 = field(default_factory=lambda: np.zeros((0, 2), np.int64))  # (I, 2) of the inliers: of cloud and view
    sightings: I64 = field(default_factory=lambda: np.zeros((0, 3), np.int64))  # see `corner_sightings`; if asked for


def rejection(reason: str, inliers: int = 0) -> Verdict:
    """The result for a rejected candidate."""
    return Verdict(reason, np.eye(4), np.zeros((6, 6)), np.zeros((0, 2), np.int64), inliers, 0.0)


def looks_alike(view: PlaceView, candidate: Keyframe, config: LoopConfig) -> bool:
    """Whether a camera's corners match those of one keyframe well enough to gather the points around it."""
    descriptors = view.descriptors[view.corner]
    matched, _ = binary.match_descriptors(
        descriptors, candidate.corners.descriptors, None, config.max_distance_bits, config.match_ratio
    )
    least = 0.5 * FIRST_SHARE * config.min_match_fraction  # the keyframes around it add the rest
    return len(matched) >= least * len(descriptors)


def verify(
    view: PlaceView, cloud: Cloud, rig: Rig, config: LoopConfig, rng: np.random.Generator, move_points: bool = True
) -> Verdict:
    """Match, estimate the pose, match again by projection, and decide.

    Args:
        move_points: finish with a bundle adjustment of the points too (stereo points are noisy, map points less so).
    """
    corners_b, corners_a = np.flatnonzero(view.corner), np.flatnonzero(cloud.corner)
    at_b, at_a = binary.match_descriptors(
        view.descriptors[corners_b], cloud.descriptors[corners_a], cloud.ids[corners_a], config.max_distance_bits,
        config.match_ratio,
    )  # fmt: skip
    rows_b, rows_a = corners_b[at_b], corners_a[at_a]
    if len(rows_b) < max(config.min_match_fraction * len(corners_b), 4):
        return rejection("too_few_matches", len(rows_b))
    matches = pair(view, cloud, rows_b, rows_a)
    start = ransac_pose(matches, rig, rng, config.sigma_px)
    if start is None:
        return rejection("no_pose")
    agree = int(consistent(start, matches, rig, config.sigma_px).sum())
    if agree < FIRST_SHARE * max(config.min_inliers, config.min_inlier_share * len(corners_b)):
        return rejection("too_few_inliers", agree)
    pose = refine_pose(start, matches, rig, config.sigma_px, GUIDED[0][1])
    return verify_near(pose.b_T_a, view, cloud, rig, config, move_points)


def verify_near(
    b_T_a: F64, view: PlaceView, cloud: Cloud, rig: Rig, config: LoopConfig, move_points: bool = False
) -> Verdict:
    """The second half of `verify`, starting from an approximate pose b_T_a (4, 4)."""
    pose: Pose | None = None
    rows_b = rows_a = np.zeros(0, np.int64)
    for radius, iterations in GUIDED:
        rows_b, rows_a = match_guided(b_T_a, view, cloud, rig, config.max_distance_bits, radius)
        if len(rows_b) < 4:
            return rejection("too_few_inliers", len(rows_b))
        pose = refine_pose(b_T_a, pair(view, cloud, rows_b, rows_a), rig, config.sigma_px, iterations)
        b_T_a = pose.b_T_a
    assert pose is not None
    rows_a, rows_b = rows_a[pose.inlier], rows_b[pose.inlier]
    corners = rows_b[view.corner[rows_b]]
    inliers, share = len(corners), len(corners) / max(int(view.corner.sum()), 1)
    if inliers < config.min_inliers or share < config.min_inlier_share:
        return rejection("too_few_inliers", inliers)
    if len(np.unique(cells_of(view.uv_left[corners], rig.left.size))) < config.min_cells:
        return rejection("not_spread", inliers)
    if move_points:
        b_T_a = refine_with_points(b_T_a, view, cloud, rows_b, rows_a, rig, config)
    pairs = np.stack([cloud.ids[rows_a], view.ids[rows_b]], axis=1)
    pairs = pairs[(pairs >= 0).all(axis=1)]
    return Verdict("", b_T_a, pose.information, pairs, inliers, share, np.stack([rows_a, rows_b], axis=1))


def corner_sightings(view: PlaceView, cloud: Cloud, rows: I64) -> I64:
    """Where the corners among the inliers (I, 2) are seen, by the camera and by all keyframes of the cloud.

    Returns:
        (S, 3) number of the corner, keyframe of the cloud (-1: camera), row there.
    """
    rows_a, rows_b = rows.T
    corner = view.corner[rows_b]
    ids, first = np.unique(cloud.ids[rows_a[corner]], return_index=True)
    camera = np.stack([np.arange(len(ids)), np.full(len(ids), -1), view.rows[rows_b[corner][first]]], axis=1)
    seen = np.flatnonzero(np.isin(cloud.ids, ids))
    around = np.stack([np.searchsorted(ids, cloud.ids[seen]), cloud.view[seen], cloud.rows[seen]], axis=1)
    return np.concatenate([camera, around])


def refine_with_points(
    b_T_a: F64, view: PlaceView, cloud: Cloud, rows_b: I64, rows_a: I64, rig: Rig, config: LoopConfig
) -> F64:
    """b_T_a from a bundle adjustment over all views of the matched points; the candidate's poses are fixed.

    As in the retail paper (section IV-C3). Adjusting the points removes the bias of a pose from noisy stereo points.
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
        sigma=np.full((len(obs_pt), 2), config.disparity_sigma_px),
    )
    return se3.inverse(bundle_adjust(rig, bundle, BundleConfig(fixed_once=True)).world_T_kf[-1])


def pair(view: PlaceView, cloud: Cloud, rows_b: I64, rows_a: I64) -> Matches:
    """Matches of rows of the camera's view and of the cloud."""
    left, right, points, sigmas = (c[rows_b] for c in (view.uv_left, view.uv_right, view.points, view.sigmas))
    known_a, seen_a = (cloud.points[rows_a], cloud.sigmas[rows_a]), cloud.seen_by_centre(rows_a)
    return Matches(*known_a, left, right, points, sigmas, *seen_a)
