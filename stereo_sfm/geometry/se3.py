"""Rigid transforms as (..., 4, 4) arrays: exponential, logarithm, inverse, interpolation, alignment.

Single ones are computed by compiled kernels: the tracker needs a dozen a frame, and numpy takes tens of microseconds
for each.

A tangent vector is xi = (rho, phi): translation part first, rotation vector second, both (..., 3).
Formulas: Barfoot, State Estimation for Robotics (2017), chapter 7; Umeyama, PAMI 13 (1991), equations 40-43.
"""

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry import se3_kernels as kernels
from stereo_sfm.types import F64

_SMALL = 1e-8


def skew(v: F64) -> F64:
    """(..., 3) -> (..., 3, 3) with skew(v) @ w = v x w."""
    v = np.asarray(v, float)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def so3_exp(phi: F64) -> F64:
    """Rotation vector (..., 3) -> rotation matrix (..., 3, 3), Rodrigues."""
    phi = np.asarray(phi, float)
    if phi.ndim == 1:
        return kernels.so3_exp_one(phi.copy())
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    k = skew(phi)
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle**2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    return np.eye(3) + a * k + b * (k @ k)


def so3_log(rotation: F64) -> F64:
    """Rotation matrix (..., 3, 3) -> rotation vector (..., 3), angle in [0, pi]."""
    if rotation.ndim == 2:
        return kernels.so3_log_one(np.array(rotation, float))
    q = quaternion_from_rotation(rotation)
    xyz, w = q[..., :3], q[..., 3]
    norm = np.linalg.norm(xyz, axis=-1)
    angle = 2 * np.arctan2(norm, w)
    factor = np.where(norm < _SMALL, 2.0 / np.where(np.abs(w) < 0.5, 1.0, w), angle / np.where(norm == 0, 1.0, norm))
    return xyz * factor[..., None]


def _left_jacobian(phi: F64) -> F64:
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    k = skew(phi)
    small = angle < 1e-5
    safe = np.where(small, 1.0, angle)
    b = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) + b * k + c * (k @ k)


def exp(xi: F64) -> F64:
    """Tangent (..., 6) = (rho, phi) -> transform (..., 4, 4)."""
    xi = np.asarray(xi, float)
    if xi.ndim == 1:
        return kernels.exp_one(xi.copy())
    out = np.zeros((*xi.shape[:-1], 4, 4))
    out[..., :3, :3] = so3_exp(xi[..., 3:])
    out[..., :3, 3] = (_left_jacobian(xi[..., 3:]) @ xi[..., :3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def log(a_T_b: F64) -> F64:
    """Transform (..., 4, 4) -> tangent (..., 6) = (rho, phi)."""
    if a_T_b.ndim == 2:
        return kernels.log_one(np.array(a_T_b, float))
    phi = so3_log(a_T_b[..., :3, :3])
    rho = np.linalg.solve(_left_jacobian(phi), a_T_b[..., :3, 3, None])[..., 0]
    return np.concatenate([rho, phi], axis=-1).astype(np.float64, copy=False)


def inverse(a_T_b: F64) -> F64:
    """(..., 4, 4) -> b_T_a."""
    if a_T_b.ndim == 2:
        return kernels.inverse_one(np.array(a_T_b, float))
    rotation = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    out = np.zeros_like(a_T_b, dtype=float)
    out[..., :3, :3] = rotation
    out[..., :3, 3] = -(rotation @ a_T_b[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def adjoint(a_T_b: F64) -> F64:
    """(..., 4, 4) -> (..., 6, 6) with T exp(xi) = exp(adjoint(T) xi) T."""
    rotation = a_T_b[..., :3, :3]
    out = np.zeros((*a_T_b.shape[:-2], 6, 6))
    out[..., :3, :3] = rotation
    out[..., 3:, 3:] = rotation
    out[..., :3, 3:] = skew(a_T_b[..., :3, 3]) @ rotation
    return out


def transform(a_T_b: F64, points_b: F64) -> F64:
    """Points (..., N, 3) of frame b -> frame a."""
    return points_b @ np.swapaxes(a_T_b[..., :3, :3], -1, -2) + a_T_b[..., None, :3, 3]


def from_rotation_translation(rotation: F64, translation: F64) -> F64:
    """(..., 3, 3), (..., 3) -> (..., 4, 4)."""
    rotation, translation = np.asarray(rotation, float), np.asarray(translation, float)
    out = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1.0
    return out


def quaternion_from_rotation(rotation: F64) -> F64:
    """(..., 3, 3) -> unit quaternion (..., 4) as x y z w, w >= 0. Largest-component branch, stable everywhere."""
    r = np.asarray(rotation, float)
    if r.ndim == 2:
        return np.array(_quaternion(r.ravel().tolist()))
    d0, d1, d2 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    xx, yy, zz, ww = 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2, 1 + d0 + d1 + d2
    xy, xz, yz = r[..., 1, 0] + r[..., 0, 1], r[..., 0, 2] + r[..., 2, 0], r[..., 2, 1] + r[..., 1, 2]
    wx, wy, wz = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    # The symmetric 4x4 matrix whose dominant eigenvector is the quaternion (Shepperd's method).
    flat = np.stack([xx, xy, xz, wx, xy, yy, yz, wy, xz, yz, zz, wz, wx, wy, wz, ww], -1)
    rows = flat.reshape(*flat.shape[:-1], 4, 4)
    four_q_sq = flat[..., ::5]
    best = np.argmax(four_q_sq, axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def _quaternion(rotation: list[float]) -> list[float]:
    """As `quaternion_from_rotation`, with the same bits, of one matrix row by row."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
    xx, yy, zz, ww = 1 + r00 - r11 - r22, 1 - r00 + r11 - r22, 1 - r00 - r11 + r22, 1 + r00 + r11 + r22
    xy, xz, yz = r10 + r01, r02 + r20, r21 + r12
    wx, wy, wz = r21 - r12, r02 - r20, r10 - r01
    rows = (xx, xy, xz, wx), (xy, yy, yz, wy), (xz, yz, zz, wz), (wx, wy, wz, ww)
    best = max(range(4), key=lambda k: rows[k][k])
    x, y, z, w = rows[best]
    norm = math.sqrt(x * x + y * y + z * z + w * w) * (-1.0 if w < 0 else 1.0)
    return [x / norm, y / norm, z / norm, w / norm]


def rotation_from_quaternion(xyzw: F64) -> F64:
    """Quaternion (..., 4) as x y z w (any norm > 0) -> (..., 3, 3); NaN for a zero quaternion."""
    q = _unit(np.asarray(xyzw, float))
    xyz, w = q[..., :3], q[..., 3]
    k = skew(xyz)
    return np.eye(3) + 2 * (w[..., None, None] * k + k @ k)


def _unit(q: F64) -> F64:
    """(..., 4) divided by its norm, also where the square of the norm overflows or vanishes."""
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        norm = np.linalg.norm(q, axis=-1, keepdims=True)
        if not ((norm > 0) & (norm < np.inf)).all():
            q = q / np.abs(q).max(axis=-1, keepdims=True)
            norm = np.linalg.norm(q, axis=-1, keepdims=True)
        return q / norm


def orthonormalize(a_T_b: F64) -> F64:
    """Nearest transform with an exact rotation (SVD), against numerical drift of long products."""
    u, _, vt = np.linalg.svd(a_T_b[..., :3, :3])
    det = np.linalg.det(u @ vt)
    u[..., :, 2] *= det[..., None]
    return from_rotation_translation(u @ vt, a_T_b[..., :3, 3])


def extent(a_T_b: F64) -> tuple[F64, F64]:
    """Size of a transform: (...) metres of translation and (...) radians of rotation."""
    if a_T_b.ndim == 2:
        size: F64 = np.array(kernels.extent_one(np.array(a_T_b, float)))
        return size[0], size[1]
    trace = np.trace(a_T_b[..., :3, :3], axis1=-2, axis2=-1)
    return np.linalg.norm(a_T_b[..., :3, 3], axis=-1), np.arccos(np.clip((trace - 1) / 2, -1, 1))


def within(a: F64, b: F64, metres: float, radians: float) -> bool:
    """Whether two transforms (4, 4) differ by less than a translation and a rotation."""
    moved, turned = extent(inverse(a) @ b)
    return bool(moved < metres and turned < radians)


def interpolate(a_T_b0: F64, a_T_b1: F64, fraction: F64 | float) -> F64:
    """Geodesic between two transforms at `fraction` in [0, 1] (may be an array of leading shape)."""
    xi = log(inverse(a_T_b0) @ a_T_b1)
    return a_T_b0 @ exp(np.asarray(fraction)[..., None] * xi)


def umeyama(source: F64, target: F64, with_scale: bool = False) -> tuple[F64, float]:
    """Least-squares similarity: target ~ scale * R @ source + t (Umeyama 1991, equations 40-43).

    Args:
        source: (N, 3). target: (N, 3).
        with_scale: estimate the scale, else it is 1.

    Returns:
        (4, 4) [R t] without the scale, and the scale.

    Raises:
        ValueError: fewer than three points, or points without extent in two directions (the rotation is not unique).
    """
    if len(source) < 3:
        raise ValueError("alignment needs at least three points")
    mean_s, mean_t = source.mean(0), target.mean(0)
    cov = (target - mean_t).T @ (source - mean_s) / len(source)
    u, d, vt = np.linalg.svd(cov)
    if d[1] <= 1e-12 * max(d[0], 1e-300):
        raise ValueError("alignment of collinear points is not unique")
    sign = np.ones(3)
    if np.linalg.det(u) * np.linalg.det(vt) < 0:
        sign[2] = -1
    rotation = (u * sign) @ vt
    scale = float((d * sign).sum() / ((source - mean_s) ** 2).sum(1).mean()) if with_scale else 1.0
    return from_rotation_translation(rotation, mean_t - scale * rotation @ mean_s), scale
