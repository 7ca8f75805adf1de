"""Rays of two cameras: depths along them, parallax, epipolar residuals. All on unit bearings (..., 3)."""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64


def ray_depths(bearings0: F64, bearings1: F64, rotation: F64, translation: F64) -> tuple[F64, F64]:
    """Distances along both rays to their closest approach, with p1 = R p0 + t.

    Args:
        bearings0, bearings1: (N, 3). rotation: (..., 3, 3). translation: (..., 3).

    Returns:
        (..., N) and (..., N); infinite or of either sign where the rays are (nearly) parallel.
    """
    a = bearings0 @ np.swapaxes(rotation, -1, -2)  # rays of camera 0 in axes of camera 1
    t = np.broadcast_to(translation[..., None, :], a.shape)
    ab, at, bt = (a * bearings1).sum(-1), (a * t).sum(-1), (bearings1 * t).sum(-1)
    sin_sq = np.maximum(1.0 - ab * ab, 1e-18)
    return (ab * bt - at) / sin_sq, (bt - ab * at) / sin_sq


def parallax_angles(bearings0: F64, bearings1: F64, rotation: F64) -> F64:
    """(N,) radians between R b0 and b1: the parallax due to translation."""
    rotated = bearings0 @ rotation.T
    return np.arctan2(np.linalg.norm(np.cross(rotated, bearings1), axis=1), (rotated * bearings1).sum(1))


def epipolar_residuals(essential: F64, bearings0: F64, bearings1: F64) -> F64:
    """First-order angular distance of correspondences to their epipolar planes (Sampson's distance on the sphere).

    Args:
        essential: (M, 3, 3). bearings0, bearings1: (N, 3).

    Returns:
        (M, N) radians.
    """
    plane1 = bearings0 @ np.swapaxes(essential, -1, -2)  # (M, N, 3) = E b0
    plane0 = bearings1 @ essential  # (M, N, 3) = E^T b1
    error = (plane1 * bearings1).sum(-1)
    slope = (plane1**2).sum(-1) + (plane0**2).sum(-1) - 2 * error**2
    return np.abs(error) / np.sqrt(np.maximum(slope, 1e-30))


def essential_from_motion(rotation: F64, translation: F64) -> F64:
    """E = [t]x R with |t| = 1, so that b1^T E b0 = 0 for p1 = R p0 + t (sparse localization paper, equation 21)."""
    return se3.skew(translation / np.linalg.norm(translation)) @ rotation
