"""Compiled models of the lenses that few cameras have; `kernels` dispatches to them by the model's id.

All of them divide x and y by a depth of their own and then distort the plane:

    tilted         depth z                             OpenCV's 14 coefficients: rational, thin prism, tilted sensor
    fov            depth z                             Devernay and Faugeras, MVA 13, 2001
    mei            depth z + xi |p|                    Mei and Rives, ICRA 2007; then k1 k2 p1 p2 (cv2.omnidir)
    double_sphere  depth on the second of two spheres  Usenko et al., 3DV 2018, equations 40 to 45
    eucm           depth on an ellipsoid               Khomutenko et al., RA-L 1, 2016

`params` of these: fx fy cx cy, the coefficients where a model shares them with the radial-tangential one, the limit of
validity at index 12, then up to six more coefficients from MORE on and the tilt's matrix (3, 3) from TILT on.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportPrivateUsage=false
# pyright: reportConstantRedefinition=false, reportMissingTypeArgument=false

from __future__ import annotations

import math
from typing import Any

from stereo_sfm.kernel_cache import jit

# The first two divide by z.
TILTED, FOV, MEI, DOUBLE_SPHERE, EUCM = 4, 5, 6, 7, 8
MORE, TILT = 13, 19
PARAMS = 28

inner: Any = jit(nogil=True, error_model="numpy", no_cpython_wrapper=True)


@inner
def radtan_distort(p, x, y):
    """Normalised (x, y) -> distorted, with the 2x2 Jacobian. OpenCV's rational model: k1 k2 p1 p2 k3 k4 k5 k6."""
    k1, k2, p1, p2, k3, k4, k5, k6 = p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11]
    r2 = x * x + y * y
    num = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    den = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    g = num / den
    dg = ((k1 + r2 * (2 * k2 + r2 * 3 * k3)) - g * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / den  # dg / d(r2)
    xd = x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    jxx = g + 2 * x * x * dg + 2 * p1 * y + 6 * p2 * x
    jxy = 2 * x * y * dg + 2 * p1 * x + 2 * p2 * y
    jyy = g + 2 * y * y * dg + 6 * p1 * y + 2 * p2 * x
    return xd, yd, jxx, jxy, jyy


@inner
def radtan_undistort(p, mx, my):
    """Newton on the 2-D distortion, started from the fixed-point iterate; NaN beyond the monotonic radius."""
    x, y = mx, my
    for _ in range(8):  # fixed-point steps into Newton's region of convergence
        r2 = x * x + y * y
        num = 1 + r2 * (p[4] + r2 * (p[5] + r2 * p[8]))
        den = 1 + r2 * (p[9] + r2 * (p[10] + r2 * p[11]))
        g = num / den
        if g <= 0.2:
            break
        x = (mx - 2 * p[6] * x * y - p[7] * (r2 + 2 * x * x)) / g
        y = (my - p[6] * (r2 + 2 * y * y) - 2 * p[7] * x * y) / g
    for _ in range(30):
        xd, yd, jxx, jxy, jyy = radtan_distort(p, x, y)
        ex, ey = xd - mx, yd - my
        det = jxx * jyy - jxy * jxy
        if abs(det) < 1e-12:
            return math.nan, math.nan
        sx = (jyy * ex - jxy * ey) / det
        sy = (jxx * ey - jxy * ex) / det
        x -= sx
        y -= sy
        if abs(sx) + abs(sy) < 1e-15:
            break
    xd, yd, jxx, jxy, jyy = radtan_distort(p, x, y)
    if not (abs(xd - mx) + abs(yd - my) < 1e-10) or (p[12] > 0 and x * x + y * y > p[12]):
        return math.nan, math.nan
    return x, y


@inner
def _tilted_distort(p, x, y):
    """As `radtan_distort` with the thin prism's s1 s2 s3 s4 and the tilted sensor; the 2x2 Jacobian row by row."""
    a, b, jxx, jxy, jyy = radtan_distort(p, x, y)
    r2 = x * x + y * y
    a += r2 * (p[13] + r2 * p[14])
    b += r2 * (p[15] + r2 * p[16])
    da, db = 2 * (p[13] + 2 * r2 * p[14]), 2 * (p[15] + 2 * r2 * p[16])  # by r2 / 2
    axx, axy, ayx, ayy = jxx + x * da, jxy + y * da, jxy + x * db, jyy + y * db
    iw = 1.0 / (p[25] * a + p[26] * b + p[27])
    u, v = (p[19] * a + p[20] * b + p[21]) * iw, (p[22] * a + p[23] * b + p[24]) * iw
    ua, ub, va, vb = (
        (p[19] - u * p[25]) * iw,
        (p[20] - u * p[26]) * iw,
        (p[22] - v * p[25]) * iw,
        (p[23] - v * p[26]) * iw,
    )
    return u, v, ua * axx + ub * ayx, ua * axy + ub * ayy, va * axx + vb * ayx, va * axy + vb * ayy


@inner
def _fov_distort(p, x, y):
    """The radius r becomes atan(2 r tan(w / 2)) / w."""
    t, r2 = 2 * math.tan(0.5 * p[13]), x * x + y * y
    q2 = r2 * t * t
    if q2 < 1e-6:  # series of the arc tangent: the next terms are below 1e-18
        s = t / p[13] * (1 - q2 * (1 / 3 - q2 / 5))
        ds = t * t * t / p[13] * (-2 / 3 + q2 * 4 / 5)
    else:
        r = math.sqrt(r2)
        s = math.atan(r * t) / (r * p[13])
        ds = (t / (p[13] * (1 + q2)) - s) / r2
    return s * x, s * y, s + ds * x * x, ds * x * y, ds * x * y, s + ds * y * y


@inner
def _plane(model, p, x, y):
    """Distortion of the plane: (u, v) and the 2x2 Jacobian row by row."""
    if model == TILTED:
        return _tilted_distort(p, x, y)
    if model == FOV:
        return _fov_distort(p, x, y)
    if model == MEI:
        u, v, jxx, jxy, jyy = radtan_distort(p, x, y)
        return u, v, jxx, jxy, jxy, jyy
    return x, y, 1.0, 0.0, 0.0, 1.0


@inner
def _depth(model, p, x, y, z):
    """What x and y are divided by, its derivatives by x (over x; by y it is the same over y) and z; NaN if not seen."""
    n = math.sqrt(x * x + y * y + z * z)
    a, b = p[13], p[14]
    if model == MEI and z > -(a if abs(a) <= 1 else 1 / a) * n:
        return z + a * n, a / n, 1 + a * z / n
    if model == DOUBLE_SPHERE:  # a is xi, b alpha
        k, kx, kz = a * n + z, a / n, 1 + a * z / n
        m = math.sqrt(x * x + y * y + k * k)
        if k > -(b / (1 - b) if b <= 0.5 else (1 - b) / b) * m:
            return b * m + (1 - b) * k, b * (1 + k * kx) / m + (1 - b) * kx, (b * k / m + 1 - b) * kz
    if model == EUCM:  # a is alpha, b beta
        m = math.sqrt(b * (x * x + y * y) + z * z)
        if z > -(a / (1 - a) if a <= 0.5 else (1 - a) / a) * m:
            return a * m + (1 - a) * z, a * b / m, a * z / m + 1 - a
    if model < MEI and z > 1e-9:
        return z, 0.0, 1.0
    return math.nan, math.nan, math.nan


@inner
def project_lens(model, p, x, y, z):
    """As `kernels.project_one`, for the models of this module."""
    d, dr, dz = _depth(model, p, x, y, z)
    a, b = x / d, y / d
    if not d > 0 or (p[12] > 0 and a * a + b * b > p[12]):
        nan = math.nan
        return nan, nan, nan, nan, nan, nan, nan, nan
    u, v, jxx, jxy, jyx, jyy = _plane(model, p, a, b)
    gx, gy, gz = dr * x / d, dr * y / d, dz / d  # the depth's gradient over the depth
    ux, vx = jxx * a + jxy * b, jyx * a + jyy * b
    fx, fy = p[0], p[1]
    return (
        fx * u + p[2],
        fy * v + p[3],
        fx * (jxx / d - ux * gx),
        fx * (jxy / d - ux * gy),
        -fx * ux * gz,
        fy * (jyx / d - vx * gx),
        fy * (jyy / d - vx * gy),
        -fy * vx * gz,
    )


@inner
def _tilted_undistort(p, u, v):
    """The tilt is undone exactly, then Newton from what is right without thin prism; NaN beyond the range."""
    # a, b with tilt @ (a, b, 1) = w (u, v, 1)
    m00, m01, m02 = p[19] - u * p[25], p[20] - u * p[26], u * p[27] - p[21]
    m10, m11, m12 = p[22] - v * p[25], p[23] - v * p[26], v * p[27] - p[24]
    det = m00 * m11 - m01 * m10
    a, b = (m02 * m11 - m01 * m12) / det, (m00 * m12 - m02 * m10) / det
    x, y = radtan_undistort(p, a, b)
    if math.isnan(x):  # close to where the radius stops growing: from inside, where the slope falls, Newton converges
        s = 0.9 * math.sqrt(p[12] / (a * a + b * b))
        x, y = s * a, s * b
    for _ in range(30):
        a, b, jxx, jxy, jyx, jyy = _tilted_distort(p, x, y)
        det = jxx * jyy - jxy * jyx
        sx = (jyy * (a - u) - jxy * (b - v)) / det
        sy = (jxx * (b - v) - jyx * (a - u)) / det
        x -= sx
        y -= sy
        if not abs(sx) + abs(sy) >= 1e-15:
            break
    a, b, jxx, jxy, jyx, jyy = _tilted_distort(p, x, y)
    if not (abs(a - u) + abs(b - v) < 1e-10) or (p[12] > 0 and x * x + y * y > p[12]):
        return math.nan, math.nan
    return x, y


@inner
def unproject_lens(model, p, u, v):
    """As `kernels.unproject_one`, for the models of this module; (u, v) without focal length and principal point."""
    x, y, z = u, v, 1.0
    if model == TILTED:
        x, y = _tilted_undistort(p, u, v)
    elif model == FOV:
        turn = math.sqrt(u * u + v * v)
        if not turn * p[13] < 0.5 * math.pi:
            return math.nan, math.nan, math.nan
        s = math.tan(turn * p[13]) / (2 * math.tan(0.5 * p[13]) * turn) if turn > 1e-12 else 1.0
        x, y = s * u, s * v
    elif model == MEI:
        x, y = radtan_undistort(p, u, v)
    r2, a, b = x * x + y * y, p[13], p[14]
    if model == MEI:
        s = (a + math.sqrt(1 + (1 - a * a) * r2)) / (1 + r2)
        x, y, z = s * x, s * y, s - a
    elif model == DOUBLE_SPHERE:
        m = (1 - b * b * r2) / (b * math.sqrt(1 - (2 * b - 1) * r2) + 1 - b)
        s = (m * a + math.sqrt(m * m + (1 - a * a) * r2)) / (m * m + r2)
        x, y, z = s * x, s * y, s * m - a
    elif model == EUCM:
        z = (1 - b * a * a * r2) / (a * math.sqrt(1 - (2 * a - 1) * b * r2) + 1 - a)
    n = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * n, y * n, z * n
