"""Rotations and rigid motions between point sets or bearings: batched Procrustes, 3-point RANSAC, translation given R.

Retail paper: Umeyama [9], the 3-point RANSAC of R-Um, and equations 11-14 of the two-step methods.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.robust import Consensus, Degenerate, ransac
from stereo_sfm.types import F64, I64


def _proper(u: F64, vt: F64) -> F64:
    """Nearest rotation (..., 3, 3) from the factors of a singular value decomposition."""
    u = u.copy()
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def rotation_between(bearings0: F64, bearings1: F64, weights: F64 | None = None) -> F64:
    """(3, 3) with b1 ~ R b0 in the least-squares sense (Wahba's problem), (N, 3) bearings.

    Raises:
        Degenerate: "too_few_matches" below two; "collinear" when all bearings are parallel.
    """
    if len(bearings0) < 2:
        raise Degenerate("too_few_matches", f"{len(bearings0)} where 2 are needed")
    weighted = bearings1 if weights is None else bearings1 * weights[:, None]
    u, s, vt = np.linalg.svd(weighted.T @ bearings0)
    if not s[1] > 1e-9 * s[0]:
        raise Degenerate("collinear", "all bearings are parallel")
    return _proper(u, vt)


def rotation_ransac(
    bearings0: F64, bearings1: F64, threshold: float, rng: np.random.Generator, max_samples: int = 128
) -> Consensus:
    """2-point RANSAC for b1 ~ R b0; `threshold` in radians. Model (3, 3).

    Raises:
        Degenerate: as `ransac`; half of the bearings must agree.
    """

    def solve(indices: I64) -> F64:
        u, s, vt = np.linalg.svd(np.swapaxes(bearings1[indices], 1, 2) @ bearings0[indices])
        return _proper(u, vt)[s[:, 1] > 1e-6 * s[:, 0]]

    def residuals(models: F64) -> F64:
        return np.linalg.norm(bearings1 - bearings0 @ np.swapaxes(models, 1, 2), axis=-1)

    return ransac(len(bearings0), 2, solve, residuals, threshold, rng, max_samples=max_samples, min_ratio=0.5)


def refuse_line(bearings: F64, threshold: float) -> None:
    """Reject points on one line of the image (a great circle), which do not determine a motion.

    Args:
        bearings: (N, 3). threshold: radians, root mean square distance from a great circle.

    Raises:
        Degenerate: "collinear".
    """
    off = np.linalg.svd(bearings, compute_uv=False)[2] / np.sqrt(len(bearings)) if len(bearings) > 2 else 0.0
    if not off > threshold:
        raise Degenerate("collinear", "all points lie on one line of the image")


def rigid_batch(source: F64, target: F64) -> F64:
    """Samples (B, K, 3), K >= 3 -> (B, 4, 4) with target ~ T source; NaN rows where the points are collinear."""
    mean_s, mean_t = source.mean(1, keepdims=True), target.mean(1, keepdims=True)
    u, s, vt = np.linalg.svd(np.swapaxes(target - mean_t, 1, 2) @ (source - mean_s))
    rotation = _proper(u, vt)
    out = se3.from_rotation_translation(rotation, (mean_t - mean_s @ np.swapaxes(rotation, 1, 2))[:, 0])
    out[s[:, 1] <= 1e-9 * s[:, 0].clip(1e-300)] = np.nan
    return out


def rigid(source: F64, target: F64, weights: F64 | None = None) -> F64:
    """(4, 4) with target ~ T source, (N, 3) points, least squares (Umeyama without scale), optionally weighted (N,).

    Raises:
        Degenerate: "too_few_matches" below three; "collinear" where the rotation is not unique.
    """
    if len(source) < 3:
        raise Degenerate("too_few_matches", f"{len(source)} where 3 are needed")
    w = np.ones(len(source)) if weights is None else weights
    w = w / w.sum()
    mean_s, mean_t = w @ source, w @ target
    u, s, vt = np.linalg.svd((target - mean_t).T @ (w[:, None] * (source - mean_s)))
    if not s[1] > 1e-10 * max(s[0], 1e-300):
        raise Degenerate("collinear", "the points do not determine a rotation")
    rotation = _proper(u, vt)
    return se3.from_rotation_translation(rotation, mean_t - rotation @ mean_s)


def rigid_ransac(
    source: F64, target: F64, threshold: float | F64, rng: np.random.Generator, max_samples: int = 256
) -> Consensus:
    """3-point RANSAC for target ~ T source; `threshold` in metres, one number or (N,). Model (4, 4).

    Raises:
        Degenerate: as `ransac`.
    """

    def solve(indices: I64) -> F64:
        models = rigid_batch(source[indices], target[indices])
        return models[np.isfinite(models).all(axis=(1, 2))]

    def residuals(models: F64) -> F64:
        return np.linalg.norm(target - se3.transform(models, source[None]), axis=-1)

    return ransac(len(source), 3, solve, residuals, threshold, rng, max_samples=max_samples, min_ratio=0.15)


def translation_ransac(
    rotated: F64,
    target: F64,
    threshold: float | F64,
    rng: np.random.Generator,
    weights: F64 | None = None,
    max_samples: int = 128,
) -> tuple[F64, Consensus]:
    """1-point RANSAC, then least squares over its inliers (retail paper, equations 11-14).

    Args:
        rotated: (N, 3) R @ last points. target: (N, 3) current points.
        threshold: metres, one number or (N,). weights: (N,) of the least squares, None for the paper's plain mean.

    Returns:
        (3,) translation and the consensus (model (3,)).

    Raises:
        Degenerate: as `ransac`.
    """
    offsets = target - rotated

    def residuals(models: F64) -> F64:
        return np.linalg.norm(offsets[None] - models[:, None], axis=-1)

    consensus = ransac(
        len(offsets),
        1,
        lambda indices: offsets[indices[:, 0]],
        residuals,
        threshold,
        rng,
        max_samples=max_samples,
        min_ratio=0.15,
        confidence=0.999999,
    )
    chosen = offsets[consensus.inliers]
    w = np.ones(len(chosen)) if weights is None else weights[consensus.inliers]
    return w @ chosen / w.sum(), consensus
