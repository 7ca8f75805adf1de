"""Homographies between bearings, and the test that rejects planes and pure rotations for monocular initialization.

Four-point DLT (Hartley and Zisserman, section 4.1) on bearings: b1 ~ H b0. The choice between a homography and an
epipolar geometry follows ORB-SLAM (Mur-Artal, Montiel, Tardos, T-RO 31, 2015, section IV): both are scored by
truncated symmetric transfer errors, and R = S_H / (S_H + S_E) above 0.45 means plane or too little parallax.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry.robust import Consensus, Degenerate, ransac
from stereo_sfm.geometry.two_view import epipolar_residuals
from stereo_sfm.types import F64, I64

PLANAR_RATIO = 0.45
_CHI2_1, _CHI2_2 = 3.84, 5.99  # 95 % of one and of two degrees of freedom


def homographies(x0: F64, x1: F64) -> F64:
    """Samples (B, K, 3), K >= 4, of bearings -> (B, 3, 3) with x1 ~ H x0, |H| = 1."""
    zero = np.zeros_like(x0)
    # x1 cross H x0 = 0; all three rows, so that no component of x1 needs to differ from zero.
    u, v, w = (x1[..., k, None] for k in range(3))
    rows = [
        np.concatenate([zero, -w * x0, v * x0], -1),
        np.concatenate([w * x0, zero, -u * x0], -1),
        np.concatenate([-v * x0, u * x0, zero], -1),
    ]
    design = np.concatenate(rows, axis=-2)
    return np.linalg.svd(design)[2][:, -1].reshape(-1, 3, 3)


def transfer_errors(models: F64, x0: F64, x1: F64) -> F64:
    """(M, N) angle in radians between x1 and H x0, sign of H free."""
    mapped = x0 @ np.swapaxes(models, -1, -2)
    mapped = mapped / np.linalg.norm(mapped, axis=-1, keepdims=True).clip(1e-15)
    sine = np.linalg.norm(np.cross(mapped, x1), axis=-1)
    return np.arcsin(sine.clip(0.0, 1.0))


def homography_ransac(
    x0: F64, x1: F64, threshold: float, rng: np.random.Generator, max_samples: int = 256
) -> Consensus:
    """Homography (3, 3) with the most support; `threshold` in radians.

    Raises:
        Degenerate: as `ransac`.
    """

    def solve(indices: I64) -> F64:
        return homographies(x0[indices], x1[indices])

    return ransac(
        len(x0), 4, solve, lambda m: transfer_errors(m, x0, x1), threshold, rng, max_samples=max_samples, min_inliers=8
    )


def planarity(essential: F64, x0: F64, x1: F64, sigma: float, rng: np.random.Generator) -> float:
    """R in [0, 1]: how well a homography explains matches, compared with an epipolar geometry (equation 2 there).

    Args:
        essential: (3, 3). x0, x1: (N, 3). sigma: radians, noise of a bearing.
    """
    try:
        model = homography_ransac(x0, x1, np.sqrt(_CHI2_2) * sigma, rng).model
    except Degenerate:
        return 0.0
    forward, backward = transfer_errors(model[None], x0, x1)[0], np.zeros(len(x0))
    if abs(np.linalg.det(model)) > 1e-12:
        backward = transfer_errors(np.asarray(np.linalg.inv(model)[None], np.float64), x1, x0)[0]
    score_h = sum(np.maximum(0.0, _CHI2_2 - (error / sigma) ** 2).sum() for error in (forward, backward))
    epipolar = epipolar_residuals(essential[None], x0, x1)[0] / sigma
    score_e = 2 * np.where(epipolar**2 < _CHI2_1, _CHI2_2 - epipolar**2, 0.0).sum()
    total = score_h + score_e
    return float(score_h / total) if total > 0 else 0.0
