"""PnP: pose from known points and their bearings, then motion-only bundle adjustment (C++ course system).

The minimal solver (OpenCV's AP3P in RANSAC) works on an image plane, so it uses bearings within 70 degrees of the axis;
the refinement uses all of them.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.motion_only import bearing_errors, refine_pose
from stereo_sfm.geometry.procrustes import refuse_line
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.papers.matching import PLANE_LIMIT
from stereo_sfm.papers.motion_estimator import EstimatorEntry, FramePair, Motion
from stereo_sfm.types import F64, Bool


def pnp_ransac(
    points: F64, bearings: F64, threshold: float, rng: np.random.Generator, max_samples: int
) -> tuple[F64, Bool]:
    """cam_T_ref (4, 4) and the inliers (N,); threshold in radians.

    Raises:
        Degenerate: "too_few_points", "no_consensus".
    """
    usable = np.flatnonzero(bearings[:, 2] > PLANE_LIMIT)
    if len(usable) < 6:
        raise Degenerate("too_few_points", f"{len(usable)} points with depth in view")
    focal = 1.0 / threshold
    plane = focal * bearings[usable, :2] / bearings[usable, 2:]
    matrix = np.diag([focal, focal, 1.0])
    cv2.setRNGSeed(int(rng.integers(1 << 31)))
    result: Any = cv2.solvePnPRansac(
        np.ascontiguousarray(points[usable]), plane, matrix, np.zeros(4), iterationsCount=max_samples,
        reprojectionError=2.0, confidence=0.9999, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    found, rvec, tvec, inliers = result
    if not found or inliers is None or not (np.isfinite(rvec).all() and np.isfinite(tvec).all()):
        raise Degenerate("no_consensus", "no pose agrees with the points")
    cam_T_ref = se3.from_rotation_translation(se3.so3_exp(rvec.ravel()), tvec.ravel())
    return cam_T_ref, bearing_errors(cam_T_ref, points, bearings) < 2 * threshold


def pnp_pose(
    points: F64, bearings: F64, pixel_rad: float, config: OdometryConfig, rng: np.random.Generator
) -> tuple[F64, Bool]:
    """RANSAC, then motion-only bundle adjustment over its inliers, twice.

    Raises:
        Degenerate: too few points, no consensus, or points that do not fix the pose.
    """
    threshold = config.epipolar_px * pixel_rad
    cam_T_ref, inliers = pnp_ransac(points, bearings, threshold, rng, config.max_samples)
    for _ in range(2 if config.refine else 0):
        if inliers.sum() < config.min_inliers:
            break
        cam_T_ref = refine_pose(points[inliers], bearings[inliers], cam_T_ref, threshold).cam_T_ref
        inliers = bearing_errors(cam_T_ref, points, bearings) < 2 * threshold
    if inliers.sum() < config.min_inliers:
        raise Degenerate("no_consensus", f"{int(inliers.sum())} of {len(points)} agree")
    refuse_line(bearings[inliers], 2 * threshold)
    return cam_T_ref, inliers


def _estimate(config: OdometryConfig, pair: FramePair, rng: np.random.Generator) -> Motion:
    """The last frame's (or keyframe's) points seen now."""
    rows = np.flatnonzero(np.isfinite(pair.points_last[:, 2]))
    now_T_last, chosen = pnp_pose(pair.points_last[rows], pair.bearings_now[rows], pair.pixel_rad, config, rng)
    return Motion(now_T_last[:3, :3], now_T_last[:3, 3], pair.marked(rows[chosen]))


ESTIMATOR = EstimatorEntry.of("perspective-n-point (C++ course system)", _estimate, needs_depth=False)
