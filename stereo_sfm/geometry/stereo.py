"""Stereo geometry: rectifying rotations, epipolar errors, triangulation."""

from __future__ import annotations

import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import F64


def rectifying_rotations(left_T_right: F64) -> tuple[F64, F64]:
    """Rotations into the common rectified axes: x along the baseline, z as close to both optical axes as possible.

    Fusiello, Trucco, Verri, Machine Vision and Applications 12 (2000), section 3, with the mean of both axes.

    Args:
        left_T_right: (4, 4).

    Returns:
        (3, 3) rect_R_left and (3, 3) rect_R_right.

    Raises:
        StereoSfmError: left and right swapped, or a baseline along the viewing direction.
    """
    baseline = left_T_right[:3, 3]
    x = baseline / np.linalg.norm(baseline)
    forward = left_T_right[:3, 2] + np.array([0.0, 0.0, 1.0])
    if abs(x @ forward) > 0.9 * np.linalg.norm(forward) or np.linalg.norm(forward) < 0.2:
        raise StereoSfmError(
            "the cameras look along their baseline or in different directions: such a pair cannot be rectified"
        )
    if x[0] < 0 and abs(x[0]) > abs(x[1]):
        raise StereoSfmError("the right camera is to the left of the left camera: images or extrinsics are swapped")
    y = _cross(forward, x)
    y /= np.linalg.norm(y)
    rect_R_left = np.stack([x, y, _cross(x, y)])
    return rect_R_left, rect_R_left @ left_T_right[:3, :3]


def _cross(a: F64, b: F64) -> F64:
    """Product of two (3,) vectors: numpy's needs ten times as long."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def epipolar_angle(bearings_left: F64, bearings_right: F64, left_T_right: F64) -> F64:
    """Signed angle (...,) in radians between the epipolar planes of two bearings, positive when the right one is lower.

    Args:
        bearings_left: (..., 3) in the left camera. bearings_right: (..., 3) in the right camera.
        left_T_right: (4, 4).
    """
    rect_R_left, rect_R_right = rectifying_rotations(left_T_right)
    a, b = bearings_left @ rect_R_left.T, bearings_right @ rect_R_right.T
    difference = np.arctan2(b[..., 1], b[..., 2]) - np.arctan2(a[..., 1], a[..., 2])
    return np.mod(difference + np.pi, 2 * np.pi) - np.pi


def triangulate(bearings_left: F64, bearings_right: F64, left_T_right: F64) -> F64:
    """Midpoint of the shortest segment between two rays, in the left camera.

    Args:
        bearings_left: (..., 3) unit, in the left camera. bearings_right: (..., 3) unit, in the right camera.
        left_T_right: (4, 4).

    Returns:
        (..., 3) metres; NaN where the rays are parallel or meet behind a camera.
    """
    a = bearings_left
    b = bearings_right @ left_T_right[:3, :3].T
    t = left_T_right[:3, 3]
    ab = (a * b).sum(-1)
    at, bt = a @ t, b @ t
    det = 1 - ab * ab
    with np.errstate(divide="ignore", invalid="ignore"):
        along_a = (at - ab * bt) / det
        along_b = (ab * at - bt) / det
        points = 0.5 * (along_a[..., None] * a + t + along_b[..., None] * b)
        good = (det > 1e-14) & (along_a > 0) & (along_b > 0)
    return np.where(good[..., None], points, np.nan)
