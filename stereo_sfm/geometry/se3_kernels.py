"""Compiled versions of `se3` functions for kernels without allocation."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.kernels import inner, njit


@inner
def exp_into(xi, seconds, out):
    """exp(seconds * xi) of a tangent (6,) = (rho, phi) per second, into `out` (4, 4)."""
    rx, ry, rz = xi[0] * seconds, xi[1] * seconds, xi[2] * seconds
    px, py, pz = xi[3] * seconds, xi[4] * seconds, xi[5] * seconds
    xx, yy, zz = px * px, py * py, pz * pz
    angle2 = xx + yy + zz
    angle = math.sqrt(angle2)
    if angle < 1e-6:
        a, b, c = 1.0 - angle2 / 6, 0.5 - angle2 / 24, 1.0 / 6 - angle2 / 120
    else:
        a, b, c = math.sin(angle) / angle, (1 - math.cos(angle)) / angle2, (angle - math.sin(angle)) / (angle2 * angle)
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - b * (yy + zz), b * px * py - a * pz, b * px * pz + a * py
    out[1, 0], out[1, 1], out[1, 2] = b * px * py + a * pz, 1.0 - b * (xx + zz), b * py * pz - a * px
    out[2, 0], out[2, 1], out[2, 2] = b * px * pz - a * py, b * py * pz + a * px, 1.0 - b * (xx + yy)
    kx, ky, kz = py * rz - pz * ry, pz * rx - px * rz, px * ry - py * rx  # phi x rho
    out[0, 3] = rx + b * kx + c * (py * kz - pz * ky)
    out[1, 3] = ry + b * ky + c * (pz * kx - px * kz)
    out[2, 3] = rz + b * kz + c * (px * ky - py * kx)
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0


@inner
def compose_into(a, b, out):
    """a @ b of two (4, 4) transforms, into `out`."""
    for i in range(3):
        for j in range(4):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j] + (a[i, 3] if j == 3 else 0.0)
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0


@inner
def rectify_rotation(t):
    """Make the rotation of a transform (4, 4) one again, in place: a product of many is only nearly orthogonal.

    One step of Newton's iteration for the polar decomposition, R (3 - R'R) / 2, whose error is the square of R's
    (Higham, Computing the polar decomposition, SIAM J. Sci. Stat. Comput. 7, 1986).
    """
    r = t[:3, :3].copy()
    for i in range(3):
        for j in range(3):
            product = 0.0
            for k in range(3):
                product += r[i, k] * (r[0, k] * r[0, j] + r[1, k] * r[1, j] + r[2, k] * r[2, j])
            t[i, j] = 1.5 * r[i, j] - 0.5 * product


@inner
def dot(a, b):
    """Product of two vectors of three coordinates."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def transform_point(t, x, y, z):
    """The three coordinates of a point after the transform t (4, 4)."""
    return (
        t[0, 0] * x + t[0, 1] * y + t[0, 2] * z + t[0, 3],
        t[1, 0] * x + t[1, 1] * y + t[1, 2] * z + t[1, 3],
        t[2, 0] * x + t[2, 1] * y + t[2, 2] * z + t[2, 3],
    )


@njit
def exp_one(xi):
    """exp of a tangent (6,) = (rho, phi): (4, 4)."""
    out = np.empty((4, 4))
    exp_into(xi, 1.0, out)
    return out


@njit
def so3_exp_one(phi):
    """Rotation (3, 3) of a rotation vector (3,)."""
    xi, out = np.zeros(6), np.empty((4, 4))
    xi[3], xi[4], xi[5] = phi[0], phi[1], phi[2]
    exp_into(xi, 1.0, out)
    return out[:3, :3].copy()


@inner
def quaternion_of(r):
    """Unit quaternion x y z w, w >= 0, of a rotation (3, 3): the largest component first (Shepperd's method)."""
    xx, yy = 1 + r[0, 0] - r[1, 1] - r[2, 2], 1 - r[0, 0] + r[1, 1] - r[2, 2]
    zz, ww = 1 - r[0, 0] - r[1, 1] + r[2, 2], 1 + r[0, 0] + r[1, 1] + r[2, 2]
    xy, xz, yz = r[1, 0] + r[0, 1], r[0, 2] + r[2, 0], r[2, 1] + r[1, 2]
    wx, wy, wz = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    x, y, z, w = xx, xy, xz, wx
    if yy > xx and yy >= zz and yy >= ww:
        x, y, z, w = xy, yy, yz, wy
    elif zz > xx and zz > yy and zz >= ww:
        x, y, z, w = xz, yz, zz, wz
    elif ww > xx and ww > yy and ww > zz:
        x, y, z, w = wx, wy, wz, ww
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    norm = -norm if w < 0 else norm
    return x / norm, y / norm, z / norm, w / norm


@njit
def so3_log_one(rotation):
    """Rotation vector (3,), angle in [0, pi], of a rotation (3, 3)."""
    x, y, z, w = quaternion_of(rotation)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 / w if sine < 1e-8 else 2.0 * math.atan2(sine, w) / sine
    return np.array([x * factor, y * factor, z * factor])


@njit
def log_one(t):
    """Tangent (6,) = (rho, phi) of a transform (4, 4)."""
    x, y, z, w = quaternion_of(t)
    sine = math.sqrt(x * x + y * y + z * z)
    angle = 2.0 * math.atan2(sine, w)
    factor = 2.0 / w if sine < 1e-8 else angle / sine
    px, py, pz = x * factor, y * factor, z * factor
    # the inverse of the left Jacobian: 1 - k / 2 + c k k, with 1 - cot(angle / 2) * angle / 2 over the squared angle
    c = 1.0 / 12 + angle * angle / 720 if angle < 1e-3 else (1.0 - 0.5 * angle * w / sine) / (angle * angle)
    tx, ty, tz = t[0, 3], t[1, 3], t[2, 3]
    kx, ky, kz = py * tz - pz * ty, pz * tx - px * tz, px * ty - py * tx
    lx, ly, lz = py * kz - pz * ky, pz * kx - px * kz, px * ky - py * kx
    return np.array([tx - 0.5 * kx + c * lx, ty - 0.5 * ky + c * ly, tz - 0.5 * kz + c * lz, px, py, pz])


@njit
def inverse_one(t):
    """Inverse (4, 4) of a transform (4, 4)."""
    out = np.zeros((4, 4))
    for i in range(3):
        for j in range(3):
            out[i, j] = t[j, i]
        out[i, 3] = -(t[0, i] * t[0, 3] + t[1, i] * t[1, 3] + t[2, i] * t[2, 3])
    out[3, 3] = 1.0
    return out


@njit
def extent_one(t):
    """Size of a transform (4, 4): metres of translation and radians of rotation."""
    cosine = 0.5 * (t[0, 0] + t[1, 1] + t[2, 2] - 1.0)
    metres = math.sqrt(t[0, 3] * t[0, 3] + t[1, 3] * t[1, 3] + t[2, 3] * t[2, 3])
    return metres, math.acos(min(max(cosine, -1.0), 1.0))
