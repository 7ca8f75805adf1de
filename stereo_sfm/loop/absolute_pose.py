"""Relative pose of two stereo cameras from matched points, with reprojection in both directions and both images.

Frame a has known points (of a keyframe or the map); the pose of frame b is estimated. Rows are matches. Where b has
stereo points too, they are projected into a. The uncertainty of a point's range along its ray is part of the weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.chi_squared import chi_squared
from stereo_sfm.loop import pose_kernels
from stereo_sfm.loop.pose_kernels import Lens
from stereo_sfm.loop.pose_kernels import add_normal_equations as add
from stereo_sfm.types import F64, Bool

CHI2_2DOF_95 = chi_squared(2, 0.95)  # sigmas^2, of a pixel beyond which a match disagrees
# Threes of matches: at a share of 0.2 that are right, four threes are right. Of them those with the likeliest ranges,
# whose poses are compared by all matches: the ranges of wrong ones differ from the measured ones.
SAMPLES, SCORED = 500, 50
STEPS = 3  # of Newton's method: an error of a tenth becomes one of a millionth
DAMPING = 1e-9 * np.eye(6)  # m^-2, rad^-2: a direction of which nothing is known stays


class Matches(NamedTuple):
    """N matched points; NaN rows for unknown values."""

    points_a: F64  # (N, 3) metres in frame a, never NaN
    sigmas_a: F64  # (N,) metres, uncertainty along the ray from a
    uv_left_b: F64  # (N, 2) px, never NaN
    uv_right_b: F64  # (N, 2) px
    points_b: F64  # (N, 3) metres in frame b
    sigmas_b: F64  # (N,)
    uv_left_a: F64  # (N, 2) px
    uv_right_a: F64  # (N, 2) px


def joined(parts: Sequence[Matches]) -> Matches:
    """All matches of several lists."""
    return Matches(*map(np.concatenate, zip(*parts, strict=True)))


@dataclass(frozen=True, eq=False)
class Pose:
    """A refined relative pose."""

    b_T_a: F64  # (4, 4)
    information: F64  # (6, 6) of exp(xi) @ b_T_a, equal to that of inverse(b_T_a) @ exp(xi)
    inlier: Bool  # (N,) consistent in every direction that could be checked


def ransac_pose(matches: Matches, rig: Rig, rng: np.random.Generator, pixel_sigma: float) -> F64 | None:
    """b_T_a (4, 4) with the smallest truncated error among the poses of many threes, None if no three give a pose."""
    if len(matches.points_a) < 4:
        return None
    rows = rng.integers(0, len(matches.points_a), (SAMPLES, 3))
    points, rays = matches.points_a[rows], rig.left.unproject(matches.uv_left_b)[rows]
    measured = np.linalg.norm(matches.points_b, axis=1)[rows]
    known = np.isfinite(measured)
    variance = matches.sigmas_a[rows] ** 2 + matches.sigmas_b[rows] ** 2
    with np.errstate(all="ignore"):  # three that give no pose become NaN
        ranges = _ranges(points, rays, np.where(known, measured, np.linalg.norm(points, axis=2)))
        off = np.where(known, (ranges - measured) ** 2 / variance, 0.0).sum(1)
        best = np.argsort(off, kind="stable")[:SCORED]
        poses = _frames(rays[best] * ranges[best, :, None]) @ se3.inverse(_frames(points[best]))
    poses = poses[np.isfinite(poses).all((1, 2))]
    if not len(poses):
        return None
    lens = Lens(rig.left.model_id, rig.left.params, pixel_sigma)
    return se3.orthonormalize(poses[pose_kernels.cheapest(poses, se3.inverse(poses), matches, lens, CHI2_2DOF_95)])


def _ranges(points: F64, rays: F64, ranges: F64) -> F64:
    """(S, 3) metres along rays (S, 3, 3) to where they are as far apart as points (S, 3, 3), nearest to `ranges`."""
    p, q, pairs = np.array([0, 0, 1]), np.array([1, 2, 2]), np.arange(3)
    cosines, squares = (rays[:, p] * rays[:, q]).sum(-1), np.square(points[:, p] - points[:, q]).sum(-1)
    columns = np.zeros((len(rays), 3, 3))  # of the Jacobian: by range, by pair
    for _ in range(STEPS):
        a, b = ranges[:, p], ranges[:, q]
        columns[:, p, pairs], columns[:, q, pairs] = 2 * (a - cosines * b), 2 * (b - cosines * a)
        adjugate = np.cross(np.roll(columns, -1, axis=1), np.roll(columns, 1, axis=1))
        determinant = (columns[:, :1] * adjugate[:, :1]).sum(-1)
        error = a * a + b * b - 2 * cosines * a * b - squares
        ranges = ranges - (adjugate @ error[..., None])[..., 0] / determinant
    return ranges


def _frames(corners: F64) -> F64:
    """(S, 4, 4) frames of triangles (S, 3, 3): from their middles, x along the first side; NaN without an area."""
    side, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(side, other)
    axes = np.stack([side, np.cross(normal, side), normal], axis=2)
    return se3.from_rotation_translation(axes / np.linalg.norm(axes, axis=1, keepdims=True), corners.mean(1))


def consistent(b_T_a: F64, matches: Matches, rig: Rig, pixel_sigma: float) -> Bool:
    """(N,): the error is within the 95 % bound from a to b, and from b to a where b has the point."""
    lens = Lens(rig.left.model_id, rig.left.params, pixel_sigma)
    return pose_kernels.consistent(b_T_a, se3.inverse(b_T_a), matches, lens, CHI2_2DOF_95)


def refine_pose(b_T_a: F64, matches: Matches, rig: Rig, pixel_sigma: float, iterations: int = 10) -> Pose:
    """Gauss-Newton on exp(xi) @ b_T_a over both images and both directions, with the inliers of every iteration."""
    t, m = b_T_a, matches
    images = [(rig.left, np.eye(4), m.uv_left_b, m.uv_left_a)]
    if rig.right is not None:
        images.append((rig.right, se3.inverse(rig.left_T_right), m.uv_right_b, m.uv_right_a))
    inlier = consistent(t, m, rig, pixel_sigma)
    hessian = np.zeros((6, 6))
    for _ in range(iterations):
        hessian, gradient, back = np.zeros((6, 6)), np.zeros(6), se3.inverse(t)
        for camera, camera_T_left, uv_b, uv_a in images:
            lens = Lens(camera.model_id, camera.params, pixel_sigma)
            ahead, behind = camera_T_left @ t, camera_T_left @ back
            add(t, ahead, camera_T_left, m.points_a, m.sigmas_a, uv_b, inlier, lens, hessian, gradient)
            add(np.eye(4), behind, -behind, m.points_b, m.sigmas_b, uv_a, inlier, lens, hessian, gradient)
        try:
            step: F64 = -np.asarray(np.linalg.solve(hessian + DAMPING, gradient), np.float64)
        except np.linalg.LinAlgError:
            break
        t = se3.exp(step) @ t
        updated = consistent(t, m, rig, pixel_sigma)
        if np.abs(step).max() < 1e-6 and np.array_equal(updated, inlier):
            break
        inlier = updated
    return Pose(se3.orthonormalize(t), hessian, inlier)
