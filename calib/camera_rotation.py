"""Rotation between the cameras from stereo matches, for rigs with unknown extrinsics.

Matched bearings satisfy the epipolar constraint. With a known direction of the baseline, the three angles of the right
camera follow from a robust fit of that constraint; the length of the baseline is not observable and stays.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, U8, StereoImage

FEATURES = 2000  # of one image
MAX_HAMMING = 40  # of 256 bits, between matched ORB descriptors
SOFT_PX = 0.5  # scale of the Cauchy loss
MIN_MATCHES = 100


@dataclass(frozen=True, eq=False)
class CameraRotation:
    """A rig with a corrected rotation of the right camera, and the epipolar errors before and after."""

    rig: Rig
    matches: int
    before_px: float  # median distance of matches from their epipolar plane, in pixels at the image centre
    after_px: float
    sigma_deg: F64  # (3,) standard deviation of the angles about x, y, z


def align_cameras(rig: Rig, images: Iterable[StereoImage]) -> CameraRotation | None:
    """Rotate the right camera of `rig` so that stereo matches satisfy the epipolar constraint.

    Args:
        rig: two cameras; its rotation is wrong by a few degrees at most.
        images: a few pairs, of different views if possible.

    Returns:
        The corrected rig, or None if too few points are matched.
    """
    from scipy.optimize import least_squares

    assert rig.right is not None
    pairs = [_match(image.left, image.right) for image in images if image.right is not None]
    if not pairs:
        return None
    uv_left, uv_right = (np.concatenate([p[side] for p in pairs]) for side in (0, 1))
    left, right = rig.left.unproject(uv_left), rig.right.unproject(uv_right)
    seen = np.isfinite(left).all(1) & np.isfinite(right).all(1)
    left, right = left[seen], right[seen]
    if len(left) < MIN_MATCHES:
        return None
    normal = np.cross(rig.left_T_right[:3, 3], left)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)

    def residual_px(angles: F64) -> F64:
        turned = right @ (rig.left_T_right[:3, :3] @ se3.so3_exp(angles)).T
        return np.arcsin(np.clip(np.einsum("ni,ni->n", normal, turned), -1, 1)) * rig.left.fx

    fit: Any = least_squares(residual_px, np.zeros(3), loss="cauchy", f_scale=SOFT_PX, x_scale=1e-3)
    transform = rig.left_T_right.copy()
    transform[:3, :3] = transform[:3, :3] @ se3.so3_exp(fit.x)
    after = np.abs(residual_px(fit.x))
    noise = 1.4826 * float(np.median(after))
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * noise**2
    return CameraRotation(
        replace(rig, left_T_right=transform),
        len(left),
        float(np.median(np.abs(residual_px(np.zeros(3))))),
        float(np.median(after)),
        np.degrees(np.sqrt(np.diag(covariance))),
    )


def _match(left: U8, right: U8) -> tuple[F64, F64]:
    """(N, 2) px in each image of mutually nearest ORB features."""
    import cv2

    orb: Any = cv2.ORB_create(FEATURES)  # pyright: ignore[reportAttributeAccessIssue]
    keys_left, descriptors_left = orb.detectAndCompute(left, None)
    keys_right, descriptors_right = orb.detectAndCompute(right, None)
    if descriptors_left is None or descriptors_right is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    found = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(descriptors_left, descriptors_right)
    good = [m for m in found if m.distance <= MAX_HAMMING]
    a = np.array([keys_left[m.queryIdx].pt for m in good]).reshape(-1, 2)
    b = np.array([keys_right[m.trainIdx].pt for m in good]).reshape(-1, 2)
    return a, b
