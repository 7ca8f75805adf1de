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
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.chi_squared import chi_squared
from stereo_sfm.loop import p3p, pose_kernels
from stereo_sfm.loop.p3p import Lens
from stereo_sfm.types import F64, I64, Bool

CHI2_2DOF_95 = chi_squared(0.95, 2)  # sigmas^2, of a pixel beyond which a match disagrees
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

    @property
    def size(self) -> int:
        """N."""
        return len(self.points_a)


def joined(parts: Sequence[Matches]) -> Matches:
    """All matches of several lists."""
    return Matches(*map(np.concatenate, zip(*parts, strict=True)))


@dataclass(frozen=True, eq=False)
class Pose:
    """A refined relative pose."""

    b_T_a: F64  # (4, 4)
    information: F64  # (6, 6) of exp(xi) @ b_T_a, equal to that of inverse(b_T_a) @ exp(xi)
    inlier: Bool  # (N,) consistent in every direction that could be checked
    rms: float  # normalised error of the inliers (1: the noise is as assumed)


def ransac_pose(
    matches: Matches, rig: Rig, rng: np.random.Generator, pixel_sigma: float, iterations: int = 400
) -> F64 | None:
    """b_T_a (4, 4) with the smallest truncated error, or None if no sample of three gives a pose."""
    if matches.size < 4:
        return None
    bearings = rig.left.unproject(matches.uv_left_b)
    usable = np.flatnonzero(np.isfinite(bearings[:, 0]))
    if len(usable) < 4:
        return None
    samples = usable[_distinct_triples(rng, len(usable), iterations)]
    lens = Lens(rig.left.model_id, rig.left.params, pixel_sigma)
    best, cost = p3p.ransac(matches, bearings, lens, CHI2_2DOF_95, samples, 0.9999)
    return se3.orthonormalize(np.vstack([best, [0, 0, 0, 1]])) if np.isfinite(cost) else None


def _distinct_triples(rng: np.random.Generator, n: int, count: int) -> I64:
    """(count, 3) rows below n, distinct within a triple."""
    a = rng.integers(0, n, count)
    b = (a + rng.integers(1, n, count)) % n
    c = rng.integers(0, n - 2, count)
    low, high = np.minimum(a, b), np.maximum(a, b)
    c = c + (c >= low)
    c = c + (c >= high)
    return np.stack([a, b, c], axis=1)


def consistent(b_T_a: F64, matches: Matches, rig: Rig, pixel_sigma: float) -> Bool:
    """(N,): the error is within the 95 % bound from a to b, and from b to a where b has the point."""
    lens = Lens(rig.left.model_id, rig.left.params, pixel_sigma)
    return pose_kernels.consistent(b_T_a, se3.inverse(b_T_a), matches, lens, CHI2_2DOF_95)


def refine_pose(b_T_a: F64, matches: Matches, rig: Rig, pixel_sigma: float, iterations: int = 10) -> Pose:
    """Gauss-Newton on exp(xi) @ b_T_a over both images and both directions, with the inliers of every iteration."""
    t = b_T_a
    inlier = consistent(t, matches, rig, pixel_sigma)
    hessian, rms = np.zeros((6, 6)), float("inf")
    right_T_left = None if rig.right is None else se3.inverse(rig.left_T_right)
    for _ in range(iterations):
        hessian, gradient, rms = _normal_equations(t, matches, rig, right_T_left, pixel_sigma, inlier)
        try:
            step: F64 = -np.asarray(np.linalg.solve(hessian + DAMPING, gradient), np.float64)
        except np.linalg.LinAlgError:
            break
        t = se3.exp(step) @ t
        updated = consistent(t, matches, rig, pixel_sigma)
        if np.abs(step).max() < 1e-6 and np.array_equal(updated, inlier):
            break
        inlier = updated
    return Pose(se3.orthonormalize(t), hessian, inlier, rms)


def _normal_equations(
    t: F64, m: Matches, rig: Rig, right_T_left: F64 | None, pixel_sigma: float, inlier: Bool
) -> tuple[F64, F64, float]:
    hessian, gradient, sums = np.zeros((6, 6)), np.zeros(6), np.zeros(2)
    back = se3.inverse(t)

    def add(camera: Camera, camera_T_left: F64, ahead: F64, behind: F64, uv_b: F64, uv_a: F64) -> None:
        seen, lens = m._replace(uv_left_b=uv_b, uv_left_a=uv_a), Lens(camera.model_id, camera.params, pixel_sigma)
        poses = t, camera_T_left, ahead, behind
        pose_kernels.add_normal_equations(*poses, seen, inlier, lens, (hessian, gradient, sums))

    add(rig.left, np.eye(4), t, back, m.uv_left_b, m.uv_left_a)
    if rig.right is not None and right_T_left is not None:
        add(rig.right, right_T_left, right_T_left @ t, right_T_left @ back, m.uv_right_b, m.uv_right_a)
    return hessian, gradient, float(np.sqrt(sums[0] / max(2 * sums[1], 1)))
