"""Relative pose of two calibrated views from point matches: eight-point, five-point, decomposition, refinement.

Retail paper equations 1-5; sparse localization paper equations 21-43; Hartley and Zisserman, Multiple View Geometry
(2nd ed.), sections 9.6 and 11.2. On bearings instead of pixels, hence the same code for pinhole and fisheye.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.epipolar_refine import refine_from_many, refine_motion
from stereo_sfm.geometry.five_point import five_point
from stereo_sfm.geometry.procrustes import refuse_line, rotation_between, rotation_ransac
from stereo_sfm.geometry.robust import Consensus, Degenerate, ransac
from stereo_sfm.geometry.two_view import epipolar_residuals, parallax_angles, ray_depths
from stereo_sfm.types import F64, I64, Bool

_MIN_GAIN = 9.0  # ratio by which a translation must improve the fit of a pure rotation to be accepted
_W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class RelativePose:
    """p1 = rotation @ p0 + scale * direction with unknown scale."""

    rotation: F64  # (3, 3)
    direction: F64  # (3,) unit; finite but meaningless for pure rotation
    inliers: Bool  # (N,) of the epipolar geometry
    in_front: Bool  # (N,) inliers that triangulate in front of both cameras
    parallax: float  # radians, median over inliers of the angle between R b0 and b1
    pure_rotation: bool  # the inliers fit a pure rotation: the direction is undetermined


def _conditioning(vectors: F64) -> F64:
    """(3, 3) similarity of Hartley's normalization when all vectors point forward, else the identity."""
    if vectors[..., 2].min() < 0.05:
        return np.eye(3)
    xy = vectors[..., :2] / vectors[..., 2:]
    mean = xy.reshape(-1, 2).mean(0)
    scale = np.sqrt(2.0) / max(float(np.sqrt(((xy - mean) ** 2).sum(-1)).mean()), 1e-12)
    return np.array([[scale, 0, -scale * mean[0]], [0, scale, -scale * mean[1]], [0, 0, 1.0]])


def _null_matrices(x0: F64, x1: F64) -> tuple[F64, F64]:
    """Samples (B, K, 3) of homogeneous vectors -> (B, 3, 3) smallest right singular matrix, (B, 9) singular values."""
    design = (x1[..., :, None] * x0[..., None, :]).reshape(*x0.shape[:-1], 9)
    design = design / np.linalg.norm(design, axis=-1, keepdims=True).clip(1e-300)
    _, values, vt = np.linalg.svd(design, full_matrices=True)
    padded = np.zeros((len(design), 9))
    padded[:, : values.shape[1]] = values
    return vt[:, 8].reshape(-1, 3, 3), padded


def eight_point(x0: F64, x1: F64) -> F64:
    """Linear fundamental (homogeneous pixels) or essential (bearings) matrix: x1^T F x0 = 0, rank 2, |F| = 1.

    Args:
        x0, x1: (N, 3), N >= 8.

    Raises:
        Degenerate: "too_few_matches"; "degenerate_points" where the equations have more than one solution (points on
            a line or a plane, repeated points, no translation).
    """
    if len(x0) < 8:
        raise Degenerate("too_few_matches", f"{len(x0)} where 8 are needed")
    t0, t1 = _conditioning(x0), _conditioning(x1)
    matrix, values = _null_matrices((x0 @ t0.T)[None], (x1 @ t1.T)[None])
    if not values[0, 7] > 1e-7 * values[0, 0]:
        raise Degenerate("degenerate_points", "the points satisfy more than one epipolar geometry")
    fundamental = t1.T @ matrix[0] @ t0
    u, s, vt = np.linalg.svd(fundamental)
    fundamental = (u[:, :2] * s[:2]) @ vt[:2]
    return fundamental / np.linalg.norm(fundamental)


def nearest_essential(matrix: F64) -> F64:
    """Closest matrix with singular values (1, 1, 0) / sqrt 2."""
    u, _, vt = np.linalg.svd(matrix)
    return (u[..., :, :2] @ vt[..., :2, :]) / np.sqrt(2.0)


def decompose(essential: F64) -> tuple[F64, F64]:
    """Four motions of an essential matrix (retail paper, equations 3-5).

    Returns:
        (4, 3, 3) rotations and (4, 3) unit translations.

    Raises:
        Degenerate: "not_essential" for a matrix of rank below two or with non-finite entries.
    """
    if not np.isfinite(essential).all():
        raise Degenerate("not_essential", "non-finite entries")
    u, s, vt = np.linalg.svd(essential)
    if s[1] <= 1e-9 * max(s[0], 1e-300):
        raise Degenerate("not_essential", "rank below two")
    u = u * np.sign(np.linalg.det(u))
    vt = vt * np.sign(np.linalg.det(vt))
    first, second, direction = u @ _W @ vt, u @ _W.T @ vt, u[:, 2]
    return np.stack([first, first, second, second]), np.stack([direction, -direction, direction, -direction])


def choose_in_front(
    rotations: F64, translations: F64, bearings0: F64, bearings1: F64, min_parallax: float = 0.0
) -> tuple[int, Bool]:
    """Index of the motion with most points in front of both cameras, and those points.

    Raises:
        Degenerate: "ambiguous_cheirality" when the runner-up has almost as many (more than 0.8 of them).
    """
    depth0, depth1 = ray_depths(bearings0, bearings1, rotations, translations)
    rotated = bearings0 @ np.swapaxes(rotations, -1, -2)
    seen = np.linalg.norm(np.cross(rotated, bearings1), axis=-1) > np.sin(min_parallax)
    front = (depth0 > 0) & (depth1 > 0) & seen
    counts = front.sum(axis=1)
    best = int(np.argmax(counts))
    runner_up = int(np.sort(counts)[-2])
    if counts[best] == 0 or runner_up > 0.8 * counts[best]:
        raise Degenerate("ambiguous_cheirality", f"{counts[best]} against {runner_up} points in front")
    return best, front[best]


def essential_ransac(
    bearings0: F64,
    bearings1: F64,
    threshold: float,
    rng: np.random.Generator,
    *,
    method: str = "five_point",
    max_samples: int = 512,
    min_ratio: float = 0.25,
) -> Consensus:
    """Essential matrix (3, 3) with the most support; `threshold` in radians, method "five_point" or "eight_point".

    Raises:
        Degenerate: as `ransac`.
    """
    size = 5 if method == "five_point" else 8

    def solve(indices: I64) -> F64:
        if method == "five_point":
            return five_point(bearings0[indices], bearings1[indices])
        matrices, values = _null_matrices(bearings0[indices], bearings1[indices])
        return nearest_essential(matrices[values[:, 7] > 1e-7 * values[:, 0]])

    return ransac(
        len(bearings0),
        size,
        solve,
        lambda matrices: epipolar_residuals(matrices, bearings0, bearings1),
        threshold,
        rng,
        max_samples=max_samples,
        min_inliers=12,
        min_ratio=min_ratio,
    )


def _small_motion(bearings0: F64, bearings1: F64, chosen: Bool, still: F64, off: F64, threshold: float) -> RelativePose:
    """The motion where a pure rotation (`still`) leaves every inlier within two thresholds.

    Without translation the squared angles `off` (two directions, noise of both views) are about 6.1 times the squared
    Sampson distances in the median; a translation is accepted if it makes them more than 9 times as large, and if at
    least two thirds of the points then lie in front.
    """
    b0, b1 = bearings0[chosen], bearings1[chosen]
    direction = np.linalg.svd(np.cross(b0 @ still.T, b1), full_matrices=False)[2][-1]
    rotation, direction = refine_from_many(still, direction, still, b0, b1, 0.5 * threshold)
    residuals = epipolar_residuals((se3.skew(direction) @ rotation)[None], b0, b1)[0]
    depth0, depth1 = ray_depths(b0, b1, rotation, direction)
    if (depth0 + depth1 < 0).mean() > 0.5:
        direction, depth0, depth1 = -direction, -depth0, -depth1
    front = (depth0 > 0) & (depth1 > 0)
    gain = float(np.median(off**2)) / max(float(np.median(residuals**2)), 1e-18)
    in_front = np.zeros_like(chosen)
    if gain < _MIN_GAIN or front.mean() < 2 / 3 or np.median(off) < 1e-9:
        return RelativePose(still, np.array([0.0, 0.0, 1.0]), chosen, in_front, float(np.median(off)), True)
    in_front[np.flatnonzero(chosen)[front]] = True
    parallax = float(np.median(parallax_angles(b0, b1, rotation)))
    return RelativePose(rotation, direction, chosen, in_front, parallax, False)


def _rotation_alone(
    bearings0: F64, bearings1: F64, threshold: float, rng: np.random.Generator, refusal: Degenerate
) -> RelativePose:
    """The pure rotation of the matches where no essential matrix fits: noise-free matches do not determine one."""
    try:
        chosen = rotation_ransac(bearings0, bearings1, 2 * threshold, rng).inliers
        refuse_line(bearings0[chosen], 2 * threshold)
    except Degenerate:
        raise refusal from None
    still = rotation_between(bearings0[chosen], bearings1[chosen])
    off = parallax_angles(bearings0[chosen], bearings1[chosen], still)
    none = np.zeros_like(chosen)
    return RelativePose(still, np.array([0.0, 0.0, 1.0]), chosen, none, float(np.median(off)), True)


def relative_pose(
    bearings0: F64,
    bearings1: F64,
    threshold: float,
    rng: np.random.Generator,
    *,
    method: str = "five_point",
    refine: bool = True,
    max_samples: int = 512,
    min_ratio: float = 0.25,
    need_direction: bool = True,
) -> RelativePose:
    """Rotation and direction of translation between two views, with detection of pure rotation.

    A pure rotation is fitted to the inliers; if it fits (almost) all of them, the essential matrix is arbitrary
    and the decomposition may pick a twisted rotation, so the fitted rotation is returned with `pure_rotation` set.
    Without `need_direction`, points too far for a reliable sign of depth are ignored.

    Raises:
        Degenerate: as `essential_ransac`, `decompose` and `choose_in_front`; "collinear" as `refuse_line`.
    """
    try:
        consensus = essential_ransac(
            bearings0, bearings1, threshold, rng, method=method, max_samples=max_samples, min_ratio=min_ratio
        )
    except Degenerate as refusal:
        return _rotation_alone(bearings0, bearings1, threshold, rng, refusal)
    chosen = consensus.inliers
    b0, b1 = bearings0[chosen], bearings1[chosen]
    refuse_line(b0, 2 * threshold)
    still = rotation_between(b0, b1)
    off = parallax_angles(b0, b1, still)
    if np.mean(off < 2 * threshold) > 0.95:
        return _small_motion(bearings0, bearings1, chosen, still, off, threshold)
    essential = consensus.model
    if method == "eight_point":
        essential = nearest_essential(eight_point(b0, b1))
    rotations, translations = decompose(essential)
    try:
        best, front = choose_in_front(rotations, translations, b0, b1)
    except Degenerate:
        if need_direction:
            raise
        # The two rotations differ by half a turn about the translation: between frames the smaller one is the motion.
        best, front = int(np.argmax(np.trace(rotations, axis1=1, axis2=2))), np.ones(len(b0), bool)
    rotation, direction = rotations[best], translations[best]
    if refine:
        # Fixed denominator: biased towards the centre of the view, which on real images (TUM fr1_xyz, 1 to 3 degrees of
        # parallax) is closer to the truth than the exact minimum: mean rotation error 0.6 instead of 1.0 degrees.
        for _ in range(3):  # refine, then update the inliers
            rotation, direction = refine_motion(
                rotation, direction, bearings0[chosen], bearings1[chosen], 0.5 * threshold, full_derivative=False
            )
            chosen = epipolar_residuals((se3.skew(direction) @ rotation)[None], bearings0, bearings1)[0] <= threshold
        depth0, depth1 = ray_depths(bearings0, bearings1, rotation, direction)
        in_front = chosen & (depth0 > 0) & (depth1 > 0)
    else:
        in_front = np.zeros_like(chosen)
        in_front[np.flatnonzero(chosen)[front]] = True
    angles = parallax_angles(bearings0[chosen], bearings1[chosen], rotation)
    parallax = float(np.median(angles)) if chosen.any() else 0.0
    return RelativePose(rotation, direction, chosen, in_front, parallax, False)
