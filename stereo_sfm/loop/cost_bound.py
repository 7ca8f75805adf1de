"""A lower bound of a pose's cost for fisheye cameras, many points at a time: most poses of a RANSAC fail by it.

The processor computes with several points at once where nothing branches and no function is called, so the arc tangent
is a series here. Its rounding depends on the processor: the bound may decide only which poses need their exact cost.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportUnknownArgumentType=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.kernel_cache import jit

SLACK = 1e-3  # more than the bound may exceed a cost by rounding, 1e-7
TERMS = 16  # of the arc tangent's series; the first one left out is below 1e-13 at the tangent of an eighth of a turn
SMALLEST = 1e-18  # m^2, added to squared distances from the axis

vectorized = jit(nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})


@njit
def make_columns(points, sigmas, uv):
    """(6, N) of the rows with a point and a pixel: the point, its range uncertainty as a share of the range, u, v."""
    columns, count = np.empty((6, points.shape[0])), 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if math.isfinite(x) and math.isfinite(uv[i, 0]):
            columns[0, count], columns[1, count], columns[2, count] = x, y, z
            columns[3, count] = sigmas[i] / (math.sqrt(x * x + y * y + z * z) + 1e-12)
            columns[4, count], columns[5, count] = uv[i, 0], uv[i, 1]
            count += 1
    return columns[:, :count].copy()


@vectorized
def fisheye_bound(t, columns, params, pixel_sigma, limit):
    """Sum of `p3p.squared_error`, each at most `limit`, over `make_columns`; for Kannala-Brandt cameras.

    `t` (3, 4) takes the points into the camera.
    """
    t00, t01, t02, t03 = t[0, 0], t[0, 1], t[0, 2], t[0, 3]
    t10, t11, t12, t13 = t[1, 0], t[1, 1], t[1, 2], t[1, 3]
    t20, t21, t22, t23 = t[2, 0], t[2, 1], t[2, 2], t[2, 3]
    fx, fy, cx, cy, k1, k2, k3, k4 = (
        params[0],
        params[1],
        params[2],
        params[3],
        params[4],
        params[5],
        params[6],
        params[7],
    )
    widest, s2 = params[12] + 1e-9, pixel_sigma * pixel_sigma
    px, py, pz, share, pu, pv = columns[0], columns[1], columns[2], columns[3], columns[4], columns[5]
    total = 0.0
    for i in range(px.shape[0]):
        rx = t00 * px[i] + t01 * py[i] + t02 * pz[i]
        ry = t10 * px[i] + t11 * py[i] + t12 * pz[i]
        rz = t20 * px[i] + t21 * py[i] + t22 * pz[i]
        x, y, z = rx + t03, ry + t13, rz + t23
        r2 = x * x + y * y + SMALLEST
        r, n2 = math.sqrt(r2), r2 + z * z
        # atan2(r, z): the angle to the nearer axis, halved.
        q = min(r, abs(z)) / max(r, abs(z))
        h = q / (1 + math.sqrt(1 + q * q))
        h2, series = h * h, 0.0
        for n in range(TERMS):
            series = 1.0 / (2 * (TERMS - n) - 1) - h2 * series
        theta = 2 * h * series
        theta = 0.5 * math.pi - theta if r > abs(z) else theta
        theta = math.pi - theta if z < 0 else theta
        t2 = theta * theta
        d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        s = d / r  # u = fx * s * x + cx
        ds = share[i] * ((slope * z / n2 - s) / r2 * (x * rx + y * ry) - slope / n2 * rz)  # along the ray
        du, dv = fx * (s * rx * share[i] + x * ds), fy * (s * ry * share[i] + y * ds)
        eu, ev = fx * s * x + cx - pu[i], fy * s * y + cy - pv[i]
        along = eu * du + ev * dv
        error = (eu * eu + ev * ev - along * along / (s2 + du * du + dv * dv)) / s2
        total += limit if theta > widest else min(error, limit)
    return total
