"""Normal equations of unknowns that all windows share, with the points and the motion of each window eliminated.

A point is a bearing and an inverse distance in the window's first left camera, so that it may be at infinity. The Schur
complements are those of Triggs et al., Bundle adjustment: a modern synthesis (2000), section 6.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from stereo_sfm.calib.scene_model import tangents
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

OUTLIER_SIGMAS = 6.0  # beyond which a point at a moment does not count once the first steps are done


class OwnUnknowns(Protocol):
    """What a window alone has."""

    bearing: F64  # (N, 3) unit
    rho: F64  # (N,) 1/m
    frame_T_first: F64  # (F, 4, 4)


@dataclass(frozen=True, eq=False)
class Eliminated:
    """The shared unknowns' equations, and a window's own steps: -(gradient + gain @ step of the other unknowns)."""

    matrix: F64  # (S, S)
    gradient: F64  # (S,)
    pose_gain: F64  # (6 (F - 1), S)
    pose_gradient: F64
    point_gain: F64  # (N, 3, R)
    point_gradient: F64  # (N, 3)

    @staticmethod
    def of(residual: F64, by_point: F64, by_rest: F64, weight: F64, shared: int) -> Eliminated:
        """The equations of one window.

        Args:
            residual: (N, 4 F) of each point, NaN where it was not seen; by_point, by_rest: (N, 4 F, 3), (N, 4 F, R) the
                prediction's derivatives, zero there. weight: (N, 4 F).
            shared: S, of the R other unknowns; the rest are the poses of all moments but the first.
        """
        r = np.nan_to_num(residual)
        wp = np.swapaxes(by_point * weight[..., None], 1, 2)
        h_pp = wp @ by_point
        damping = 1e-9 + 1e-9 * np.trace(h_pp, axis1=1, axis2=2)
        inverse = np.linalg.inv(h_pp + damping[:, None, None] * np.eye(3))
        h_pr = wp @ by_rest  # (N, 3, R)
        point_gain, point_gradient = inverse @ h_pr, -(inverse @ (wp @ r[..., None]))[..., 0]
        flat = by_rest.reshape(-1, by_rest.shape[2])
        weighted = flat * weight.reshape(-1, 1)
        h = flat.T @ weighted - np.tensordot(h_pr, point_gain, ((0, 1), (0, 1)))
        g = -weighted.T @ r.reshape(-1) - np.tensordot(h_pr, point_gradient, ((0, 1), (0, 1)))
        own = h[shared:, shared:] + 1e-6 * np.eye(len(h) - shared)
        pose_gain = np.asarray(np.linalg.solve(own, h[shared:, :shared]), float)
        pose_gradient = np.asarray(np.linalg.solve(own, g[shared:]), float)
        across = h[:shared, shared:]
        matrix = np.asarray(h[:shared, :shared] - across @ pose_gain, float)
        gradient = np.asarray(g[:shared] - across @ pose_gradient, float)
        return Eliminated(matrix, gradient, pose_gain, pose_gradient, point_gain, point_gradient)

    def apply(self, step: F64, window: OwnUnknowns) -> None:
        """Back-substitute a step (S,) of the shared unknowns into the window's poses and points."""
        pose = -(self.pose_gradient + self.pose_gain @ step)
        moved = -(self.point_gradient + self.point_gain @ np.concatenate([step, pose]))
        turned = window.bearing + (tangents(window.bearing) @ moved[:, :2, None])[..., 0]
        window.bearing = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        window.rho = window.rho + moved[:, 2]
        window.frame_T_first[1:] = se3.exp(pose.reshape(-1, 6)) @ window.frame_T_first[1:]


def point_noise(residual: F64) -> F64:
    """Of each point with four rows or more, its own estimate of the noise of a coordinate; the median is unbiased.

    A point's three unknowns leave one of four rows, five of eight, and so on; the median of chi-squared with k degrees
    of freedom is k (1 - 2 / 9k)^3 (Wilson and Hilferty, PNAS 17, 1931).
    """
    rows = np.isfinite(residual).sum(1)
    usable = rows >= 4
    free = rows[usable] - 3
    size = np.sqrt(np.nansum(residual[usable] ** 2, 1) / free)
    return size / (1 - 2 / (9 * free)) ** 1.5


def robust_weights(residual: F64, scale: float, most: float) -> F64:
    """Weights of Cauchy's loss, of a scale in px, by the worst row of a point at a moment.

    Zero for missing rows and beyond `most` px.
    """
    count, rows = residual.shape
    size = np.abs(np.nan_to_num(residual)).reshape(count, rows // 4, 4).max(2)
    worst = np.repeat(size, 4, axis=1)
    return np.where(np.isfinite(residual) & (worst <= most), 1 / (1 + (worst / scale) ** 2), 0.0)
