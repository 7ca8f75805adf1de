"""Least squares on the epipolar geometry of two views, robust to the local minima of narrow views."""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.two_view import epipolar_residuals
from stereo_sfm.types import F64


def refine_motion(
    rotation: F64,
    direction: F64,
    bearings0: F64,
    bearings1: F64,
    scale: float,
    iterations: int = 8,
    full_derivative: bool = True,
) -> tuple[F64, F64]:
    """Gauss-Newton on the spherical Sampson distance with Cauchy weights of width `scale` radians.

    Five parameters: a rotation vector on the left of `rotation` and two on the sphere of directions.
    `full_derivative` differentiates the whole distance and converges to the nearest minimum. Otherwise the denominator
    is fixed in each step: biased towards the centre of the view, but able to leave local minima.
    """
    for _ in range(iterations):
        p = bearings0 @ rotation.T
        plane1, plane0 = np.cross(direction, p), np.cross(direction, bearings1)
        error = (bearings1 * plane1).sum(1)
        slope = np.sqrt(np.maximum((plane1**2).sum(1) + (plane0**2).sum(1) - 2 * error**2, 1e-20))
        residual = error / slope
        weight = 1.0 / (1.0 + (residual / scale) ** 2)
        by_rotation, by_direction = np.cross(p, np.cross(bearings1, direction)), np.cross(p, bearings1)
        if full_derivative:
            half_rotation = np.cross(p, np.cross(plane1, direction)) - 2 * error[:, None] * by_rotation
            half_direction = np.cross(p, plane1) + np.cross(bearings1, plane0) - 2 * error[:, None] * by_direction
            by_rotation = by_rotation - (residual / slope)[:, None] * half_rotation
            by_direction = by_direction - (residual / slope)[:, None] * half_direction
        by_rotation, by_direction = by_rotation / slope[:, None], by_direction / slope[:, None]
        tangent = np.linalg.svd(direction[None])[2][1:]  # (2, 3) basis orthogonal to the direction
        jac = np.concatenate([by_rotation, by_direction @ tangent.T], axis=1)
        hessian = jac.T @ (weight[:, None] * jac)
        step = -np.linalg.solve(hessian + 1e-9 * np.trace(hessian) * np.eye(5), jac.T @ (weight * residual))
        rotation = se3.so3_exp(step[:3]) @ rotation
        direction = direction + step[3:] @ tangent
        direction = direction / np.linalg.norm(direction)
        if np.abs(step).max() < 1e-10:
            break
    return rotation, direction


def refine_from_many(
    rotation: F64, direction: F64, still: F64, bearings0: F64, bearings1: F64, scale: float
) -> tuple[F64, F64]:
    """The best of `refine_motion` from a solution and from translations along each axis with the rotation `still`.

    In a narrow view a small sideways translation resembles a rotation, and the cost has a minimum for each: one start
    is not enough. Pass all matches (Cauchy weights handle outliers), not the inliers of one solution, which would
    favour it. The signs of the directions are arbitrary.
    """
    starts = [(rotation, direction), *((still, axis) for axis in np.eye(3))]
    starts += [
        refine_motion(still, axis, bearings0, bearings1, scale, iterations=8, full_derivative=False)
        for axis in np.eye(3)
    ]
    refined = [refine_motion(r, d, bearings0, bearings1, scale, iterations=12) for r, d in starts]
    costs = [
        np.log1p((epipolar_residuals((se3.skew(d) @ r)[None], bearings0, bearings1)[0] / scale) ** 2).sum()
        for r, d in refined
    ]
    best = int(np.argmin(costs))  # a plane has two exact solutions: keep the first unless another is clearly better
    return refined[best] if costs[best] < 0.99 * costs[0] - 1e-9 * len(bearings0) else refined[0]
