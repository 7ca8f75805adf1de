"""Start of a monocular map from two views: the C++ course's 90 % rule, guarded against planes and little parallax."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.essential import relative_pose
from stereo_sfm.geometry.homography import PLANAR_RATIO, planarity
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.geometry.stereo import triangulate
from stereo_sfm.geometry.two_view import essential_from_motion, parallax_angles
from stereo_sfm.types import F64, Bool, Message

# Matches, and points of them, of a start: a map that the next views can be matched with.
MIN_MATCHES, MIN_POINTS = 50, 40
MIN_PARALLAX_DEG = 1.0  # least median of a start, and of new points: depths are then known to some percent


@dataclass(frozen=True, eq=False)
class TwoViewStart(Message):
    """Second camera and points in the first one's frame; the unit of length is the median distance of the points."""

    first_T_second: F64  # (4, 4)
    points: F64  # (N, 3) in the first camera, NaN where not triangulated


def start_from(b0: F64, b1: F64, pixel: float, config: OdometryConfig, rng: np.random.Generator) -> TwoViewStart:
    """Motion and points from matched bearings (N, 3).

    Raises:
        Degenerate: "too_few_matches", "below_share" (fewer than 90 % fit), "pure_rotation", "planar_or_low_parallax",
            "low_parallax", "too_few_points", or what the essential matrix refuses.
    """
    if len(b0) < MIN_MATCHES:
        raise Degenerate("too_few_matches", f"{len(b0)} of {MIN_MATCHES}")
    threshold = 2 * config.epipolar_px * pixel
    pose = relative_pose(b0, b1, threshold, rng, max_samples=config.max_samples)
    if pose.pure_rotation:
        raise Degenerate("pure_rotation", "the camera has only turned")
    share = float(pose.inliers.mean())
    if share < config.init_share:
        raise Degenerate("below_share", f"{share:.0%} of the matches fit")
    if pose.parallax < np.radians(MIN_PARALLAX_DEG):
        raise Degenerate("low_parallax", f"{np.degrees(pose.parallax):.2f} degrees")
    essential = essential_from_motion(pose.rotation, pose.direction)
    ratio = planarity(essential, b0, b1, config.epipolar_px * pixel, rng)
    if ratio > PLANAR_RATIO:
        raise Degenerate("planar_or_low_parallax", f"homography ratio {ratio:.2f}")
    first_T_second = se3.inverse(se3.from_rotation_translation(pose.rotation, pose.direction))
    points = good_points(b0, b1, first_T_second, threshold, np.radians(0.5 * MIN_PARALLAX_DEG))
    points[~pose.inliers] = np.nan
    found = np.isfinite(points[:, 2])
    if found.sum() < MIN_POINTS:
        raise Degenerate("too_few_points", f"{int(found.sum())} points triangulate")
    unit = float(np.median(np.linalg.norm(points[found], axis=1)))
    first_T_second[:3, 3] /= unit
    return TwoViewStart(first_T_second, points / unit)


def good_points(b0: F64, b1: F64, first_T_second: F64, max_error: float, min_parallax: float) -> F64:
    """(N, 3) midpoints in the first camera, NaN where the rays miss each other, are too parallel, or meet behind."""
    points = triangulate(b0, b1, first_T_second)
    parallax = parallax_angles(b0, b1, first_T_second[:3, :3].T)
    keep: Bool = (parallax > min_parallax) & np.isfinite(points[:, 2])
    for bearings, cam_T_first in ((b0, np.eye(4)), (b1, se3.inverse(first_T_second))):
        seen = se3.transform(cam_T_first, np.nan_to_num(points, nan=1.0))
        error = np.linalg.norm(seen / np.linalg.norm(seen, axis=1, keepdims=True).clip(1e-12) - bearings, axis=1)
        keep &= error < max_error
    return np.where(keep[:, None], points, np.nan)
