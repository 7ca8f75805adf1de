"""Motion-only bundle adjustment on bearings: Gauss-Newton with Huber weights, points fixed, for any camera model.

The residual of a point is the chord between its predicted and its observed unit bearing, close to the angle in
radians; divided by the angle of a pixel it is the reprojection error at the image centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.types import F64


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """cam_T_ref with residuals and covariance."""

    cam_T_ref: F64  # (4, 4)
    residuals: F64  # (N,) radians
    covariance: F64  # (6, 6) of exp(xi) @ cam_T_ref for residuals of `sigma` radians


def bearing_errors(cam_T_ref: F64, points: F64, bearings: F64) -> F64:
    """(N,) chord between predicted and observed bearings, radians."""
    seen = se3.transform(cam_T_ref, points)
    return np.linalg.norm(seen / np.linalg.norm(seen, axis=1, keepdims=True).clip(1e-12) - bearings, axis=1)


def pose_covariance(points_cam: F64, sigma: float) -> F64:
    """(6, 6) covariance of a camera pose T @ exp(xi) fitted to N points with `sigma` radians of noise each.

    Points (N, 3) in the camera. Undetermined directions get a large, finite variance.
    """
    distance = np.linalg.norm(points_cam, axis=1).clip(1e-9)
    unit = points_cam / distance[:, None]
    across = (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / distance[:, None, None]
    jac = np.concatenate([across, -across @ se3.skew(points_cam)], axis=2)
    hessian = np.einsum("nij,nik->jk", jac, jac) / sigma**2 + np.eye(6)
    return np.asarray(np.linalg.inv(hessian), np.float64)


def refine_pose(points: F64, bearings: F64, cam_T_ref: F64, sigma: float, iterations: int = 10) -> RefinedPose:
    """Least squares from a close initial pose.

    Args:
        points: (N, 3) metres in the reference frame. bearings: (N, 3) unit, in the camera.
        cam_T_ref: (4, 4) initial pose. sigma: radians, noise of a bearing; Huber's bound is 2 sigma.

    Raises:
        Degenerate: "too_few_points" below three, "ill_conditioned" where the points do not determine the pose.
    """
    if len(points) < 3:
        raise Degenerate("too_few_points", f"{len(points)} where 3 are needed")
    hessian = np.zeros((6, 6))
    for _ in range(iterations):
        seen = se3.transform(cam_T_ref, points)
        distance = np.linalg.norm(seen, axis=1).clip(1e-9)
        unit = seen / distance[:, None]
        error = unit - bearings
        size = np.linalg.norm(error, axis=1)
        weight = np.minimum(1.0, 2 * sigma / np.maximum(size, 1e-15))
        across = (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / distance[:, None, None]
        jac = np.concatenate([across, -across @ se3.skew(seen)], axis=2)  # (N, 3, 6)
        hessian = np.einsum("n,nij,nik->jk", weight, jac, jac)
        gradient = np.einsum("n,nij,ni->j", weight, jac, error)
        scale = np.sqrt(np.diag(hessian)).clip(1e-300)
        if np.linalg.cond(hessian / np.outer(scale, scale)) > 1e12:
            raise Degenerate("ill_conditioned", "the points do not determine the pose")
        step = -np.linalg.solve(hessian, gradient)
        cam_T_ref = se3.exp(step) @ cam_T_ref
        if np.abs(step).max() < 1e-9:
            break
    covariance = np.asarray(np.linalg.inv(hessian) * sigma**2, np.float64)
    return RefinedPose(cam_T_ref, bearing_errors(cam_T_ref, points, bearings), covariance)
