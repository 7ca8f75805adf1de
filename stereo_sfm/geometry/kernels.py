"""Compiled scalar camera kernels. One function per model; `project_one` and `unproject_one` dispatch on its id.

Everything that projects (cameras, motion-only optimisation, bundle adjustment, the simulator) uses these: each model
has one implementation, the rarer ones in `lens_kernels`. `params` is always a float64 array of one length: fx fy cx
cy, eight distortion coefficients, then the limit of validity at index 12 (pinhole: largest squared normalised radius;
Kannala-Brandt: largest angle from the axis; 0 means none), then what only the rarer models have.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportPrivateUsage=false
# pyright: reportConstantRedefinition=false, reportMissingTypeArgument=false

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stereo_sfm.geometry.lens_kernels import project_lens, radtan_distort, radtan_undistort, unproject_lens
from stereo_sfm.kernel_cache import jit

PINHOLE, RADTAN, KANNALA_BRANDT, EPIPOLAR = 0, 1, 2, 3  # above: lens_kernels
LIMIT = 12

njit: Any = jit(nogil=True, error_model="numpy")
# For kernels that only kernels call: less to compile, but Python, which finds nothing to call, would crash.
inner: Any = jit(nogil=True, error_model="numpy", no_cpython_wrapper=True)
# For small ones that are called for every point: a call, whose results pass through memory, takes longer than they do.
inlined: Any = jit(nogil=True, error_model="numpy", no_cpython_wrapper=True, forceinline=True)


@inlined
def project_one(model, p, x, y, z):
    """Point in the camera -> (u, v, J00, J01, J02, J10, J11, J12), NaN outside the model's range."""
    nan = math.nan
    fx, fy, cx, cy = p[0], p[1], p[2], p[3]
    if model == 0 or model == 1:
        if z <= 1e-9:
            return nan, nan, nan, nan, nan, nan, nan, nan
        iz = 1.0 / z
        a, b = x * iz, y * iz
        if model == 0:
            return fx * a + cx, fy * b + cy, fx * iz, 0.0, -fx * a * iz, 0.0, fy * iz, -fy * b * iz
        if p[12] > 0 and a * a + b * b > p[12]:
            return nan, nan, nan, nan, nan, nan, nan, nan
        xd, yd, jxx, jxy, jyy = radtan_distort(p, a, b)
        return (
            fx * xd + cx,
            fy * yd + cy,
            fx * jxx * iz,
            fx * jxy * iz,
            -fx * (jxx * a + jxy * b) * iz,
            fy * jxy * iz,
            fy * jyy * iz,
            -fy * (jxy * a + jyy * b) * iz,
        )
    if model == 2:
        r2 = x * x + y * y
        r = math.sqrt(r2)
        theta = math.atan2(r, z)
        if theta > p[12]:
            return nan, nan, nan, nan, nan, nan, nan, nan
        t2 = theta * theta
        d = theta * (1 + t2 * (p[4] + t2 * (p[5] + t2 * (p[6] + t2 * p[7]))))
        dd = 1 + t2 * (3 * p[4] + t2 * (5 * p[5] + t2 * (7 * p[6] + t2 * 9 * p[7])))
        n2 = r2 + z * z
        if r < 1e-9 * abs(z) or r < 1e-15:
            if z <= 0:
                return nan, nan, nan, nan, nan, nan, nan, nan
            iz = 1.0 / z
            return (
                fx * x * iz + cx,
                fy * y * iz + cy,
                fx * iz,
                0.0,
                -fx * x * iz * iz,
                0.0,
                fy * iz,
                -fy * y * iz * iz,
            )
        s = d / r  # u = fx * s * x + cx
        dtheta_r = z / n2
        dtheta_z = -r / n2
        ds_r = (dd * dtheta_r - s) / r  # d s / d r
        ds_z = dd * dtheta_z / r
        c, w = x / r, y / r
        return (
            fx * s * x + cx,
            fy * s * y + cy,
            fx * (s + x * ds_r * c),
            fx * x * ds_r * w,
            fx * x * ds_z,
            fy * y * ds_r * c,
            fy * (s + y * ds_r * w),
            fy * y * ds_z,
        )
    if model > 3:
        return project_lens(model, p, x, y, z)
    # Epipolar-aligned (longitude along the baseline's plane, latitude = angle of that plane): rows are epipolar lines.
    q2 = y * y + z * z
    q = math.sqrt(q2)
    n2 = q2 + x * x
    if q < 1e-12:
        return nan, nan, nan, nan, nan, nan, nan, nan
    alpha = math.atan2(x, q)
    beta = math.atan2(y, z)
    dx = q / n2
    dq = -x / n2
    return (
        fx * alpha + cx,
        fy * beta + cy,
        fx * dx,
        fx * dq * y / q,
        fx * dq * z / q,
        0.0,
        fy * z / q2,
        -fy * y / q2,
    )


@inner
def unproject_one(model, p, u, v):
    """Pixel -> unit bearing, NaN where the model is not invertible."""
    nan = math.nan
    mx = (u - p[2]) / p[0]
    my = (v - p[3]) / p[1]
    if not (math.isfinite(mx) and math.isfinite(my)):
        return nan, nan, nan
    if model == 0 or model == 1:
        x, y = mx, my
        if model == 1:
            x, y = radtan_undistort(p, mx, my)
        n = 1.0 / math.sqrt(x * x + y * y + 1)
        return x * n, y * n, n
    if model == 2:
        d = math.sqrt(mx * mx + my * my)
        if d < 1e-12:
            n = 1.0 / math.sqrt(d * d + 1)
            return mx * n, my * n, n
        theta = _kb_theta(p, d)
        s = math.sin(theta) / d
        return mx * s, my * s, math.cos(theta)
    if model > 3:
        return unproject_lens(model, p, mx, my)
    if abs(mx) >= 0.5 * math.pi or abs(my) > math.pi:
        return nan, nan, nan
    ca = math.cos(mx)
    return math.sin(mx), ca * math.sin(my), ca * math.cos(my)


@inner
def _kb_theta(p, d):
    """Solve theta * (1 + k1 theta^2 + ...) = d on [0, limit] by Newton steps kept inside a shrinking bracket.

    A step longer than half the previous one is replaced by bisection: near the limit Newton may cycle.
    """
    lo, hi = 0.0, p[12]
    h2 = hi * hi
    if d > hi * (1 + h2 * (p[4] + h2 * (p[5] + h2 * (p[6] + h2 * p[7])))):
        return math.nan
    theta, before = min(d, hi), hi
    for _ in range(100):
        t2 = theta * theta
        f = theta * (1 + t2 * (p[4] + t2 * (p[5] + t2 * (p[6] + t2 * p[7])))) - d
        if f > 0:
            hi = theta
        else:
            lo = theta
        df = 1 + t2 * (3 * p[4] + t2 * (5 * p[5] + t2 * (7 * p[6] + t2 * 9 * p[7])))
        new = theta - f / df if df > 1e-12 else 0.5 * (lo + hi)
        if not (lo <= new <= hi) or abs(new - theta) > max(0.5 * before, 1e-12):
            new = 0.5 * (lo + hi)
        before = abs(new - theta)
        if before < 1e-15:
            return new
        theta = new
    return theta


@njit
def project_many(model, p, points):
    """(N, 3) -> (N, 2) px."""
    uv = np.empty((points.shape[0], 2))
    for i in range(points.shape[0]):
        r = project_one(model, p, points[i, 0], points[i, 1], points[i, 2])
        uv[i, 0], uv[i, 1] = r[0], r[1]
    return uv


@njit
def project_many_jacobian(model, p, points):
    """(N, 3) -> (N, 2) px and (N, 2, 3) derivatives by the point."""
    n = points.shape[0]
    uv = np.empty((n, 2))
    jac = np.empty((n, 2, 3))
    for i in range(n):
        r = project_one(model, p, points[i, 0], points[i, 1], points[i, 2])
        uv[i, 0], uv[i, 1] = r[0], r[1]
        jac[i, 0, 0], jac[i, 0, 1], jac[i, 0, 2] = r[2], r[3], r[4]
        jac[i, 1, 0], jac[i, 1, 1], jac[i, 1, 2] = r[5], r[6], r[7]
    return uv, jac


@njit
def unproject_many(model, p, uv):
    """(N, 2) px -> (N, 3) unit bearings."""
    out = np.empty((uv.shape[0], 3))
    for i in range(uv.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = unproject_one(model, p, uv[i, 0], uv[i, 1])
    return out
