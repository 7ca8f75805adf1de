"""Compiled versions of `se3` functions for kernels without allocation."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math

from stereo_sfm.geometry.kernels import njit


@njit
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


@njit
def compose_into(a, b, out):
    """a @ b of two (4, 4) transforms, into `out`."""
    for i in range(3):
        for j in range(4):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j] + (a[i, 3] if j == 3 else 0.0)
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0


@njit
def transform_point(t, x, y, z):
    """The three coordinates of a point after the transform t (4, 4)."""
    return (
        t[0, 0] * x + t[0, 1] * y + t[0, 2] * z + t[0, 3],
        t[1, 0] * x + t[1, 1] * y + t[1, 2] * z + t[1, 3],
        t[2, 0] * x + t[2, 1] * y + t[2, 2] * z + t[2, 3],
    )
