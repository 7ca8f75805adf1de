"""Eight-point: essential matrix by RANSAC over eight matches, decomposition, accumulation (sparse localization paper).

The paper's equations 21-43. Its translation has no scale: here the scale is that of the metric points where there are
any, else the tracker decides (unit steps, or ground truth).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry.essential import RelativePose, relative_pose
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.papers.motion_estimator import EstimatorEntry, FramePair, Motion


def scale_from_points(rotation: np.ndarray, direction: np.ndarray, pair: FramePair, inliers: np.ndarray) -> float:
    """Metres along `direction`, so that R p_last + s d lies on the current ray: weighted median over inliers.

    A point far away says little about s: each is weighed by the parallax that a unit step gives it.

    Raises:
        Degenerate: "no_scale" with fewer than five points of known depth.
    """
    rows = inliers & np.isfinite(pair.points_last[:, 2])
    if rows.sum() < 5:  # whose median withstands two wrong ones
        raise Degenerate("no_scale", f"{int(rows.sum())} matches have depth")
    moved = pair.points_last[rows] @ rotation.T
    ray = pair.bearings_now[rows]
    # Components across the ray: moved_perp + s * direction_perp = 0.
    moved_perp = moved - (moved * ray).sum(1, keepdims=True) * ray
    direction_perp = direction - (ray @ direction)[:, None] * ray
    weight = np.linalg.norm(direction_perp, axis=1)
    steps = -(moved_perp * direction_perp).sum(1) / np.maximum(weight**2, 1e-12)
    weight = weight / np.linalg.norm(moved, axis=1)
    order = np.argsort(steps, kind="stable")
    cumulative = np.cumsum(weight[order])
    return float(steps[order][np.searchsorted(cumulative, 0.5 * cumulative[-1])])


def motion_of_rays(
    config: OdometryConfig, pair: FramePair, rng: np.random.Generator, **options: Any
) -> tuple[RelativePose, dict[str, float]]:
    """Rotation and direction of the matches' rays, and the statistics of a `Motion` from them.

    Args: options, of `relative_pose`.
    """
    threshold = config.epipolar_px * pair.pixel_rad
    pose = relative_pose(
        pair.bearings_last, pair.bearings_now, threshold, rng, refine=config.refine, max_samples=config.max_samples,
        **options,
    )  # fmt: skip
    return pose, {"parallax_deg": float(np.degrees(pose.parallax)), "pure_rotation": float(pose.pure_rotation)}


def _estimate(config: OdometryConfig, pair: FramePair, rng: np.random.Generator) -> Motion:
    pose, stats = motion_of_rays(config, pair, rng, method="eight_point")
    step, metric = 1.0, True
    if pose.pure_rotation:
        step = 0.0
    elif config.scale != "stereo":
        metric = False
    else:
        step = scale_from_points(pose.rotation, pose.direction, pair, pose.inliers)
    return Motion(pose.rotation, step * pose.direction, pose.inliers, metric, stats)


ESTIMATOR = EstimatorEntry.of(
    "essential matrix by eight points (sparse localization paper)", _estimate, needs_depth=False
)
