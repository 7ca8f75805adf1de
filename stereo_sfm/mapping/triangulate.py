"""Triangulation of points from all their observations with fixed keyframes, as initial values of bundle adjustment.

A point's first depth comes from one stereo pair and may be far off (a fisheye sees points along its own baseline). When
several keyframes observe it, distances along its first ray are tried from near to far, and the best is refined by
Levenberg-Marquardt with a Cauchy loss, each point with its own damping.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry.kernels import inlined, inner, njit, project_one
from stereo_sfm.geometry.se3_kernels import transform_point
from stereo_sfm.geometry.small_matrix import solve_symmetric
from stereo_sfm.mapping.map import Map
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.types import F64, I64

TRIALS = 8  # distances tried
NEAREST, FARTHEST = 4.0, 4000.0  # baselines (a rig with one camera: of 5 cm)
STEPS = 8  # of Levenberg-Marquardt at most


@inlined
def _accumulate(seen, u_obs, v_obs, inv_sigma, m, derive, h, b):
    """Cauchy cost of a point in one image, `seen` as `project_one` returns it.

    If `derive`, its normal equations are added in the axes of m (3, 3) = world -> camera.
    """
    u, v, j00, j01, j02, j10, j11, j12 = seen
    if not (math.isfinite(u) and math.isfinite(v)):
        return 10.0
    ru, rv = (u - u_obs) * inv_sigma, (v - v_obs) * inv_sigma
    if not math.isfinite(rv):  # only u was seen
        rv, j10, j11, j12 = 0.0, 0.0, 0.0, 0.0
    chi2 = ru * ru + rv * rv
    if derive:
        w = inv_sigma / (1.0 + chi2 / 4.0)
        for i in range(3):
            gu = j00 * m[0, i] + j01 * m[1, i] + j02 * m[2, i]
            gv = j10 * m[0, i] + j11 * m[1, i] + j12 * m[2, i]
            b[i] -= w * (gu * ru + gv * rv)
            for k in range(i + 1):
                hu = j00 * m[0, k] + j01 * m[1, k] + j02 * m[2, k]
                hv = j10 * m[0, k] + j11 * m[1, k] + j12 * m[2, k]
                h[i, k] += w * inv_sigma * (gu * hu + gv * hv)
    return 2.0 * math.log1p(chi2 / 4.0)


class Seen(NamedTuple):
    """Observations of several points, sorted by point."""

    kf: I64  # (M,)
    uv_left: F64  # (M, 2) px
    uv_right: F64  # (M, 2) px
    sigma: F64  # (M,) px


@inner
def _cost(x, first, last, rot, pos, rows, cameras, limit, derive, m, h, b):
    """Cauchy cost of a point, and if `derive` its normal equations, lower triangle; both end at a cost of `limit`.

    m: (3, 3) scratch.
    """
    t = cameras.right_T_left
    if derive:
        h[:] = 0.0
        b[:] = 0.0
    cost = 0.0
    for o in range(first, last):
        if cost >= limit:
            break
        k = rows.kf[o]
        d0, d1, d2 = x[0] - pos[k, 0], x[1] - pos[k, 1], x[2] - pos[k, 2]
        p0 = rot[k, 0, 0] * d0 + rot[k, 1, 0] * d1 + rot[k, 2, 0] * d2
        p1 = rot[k, 0, 1] * d0 + rot[k, 1, 1] * d1 + rot[k, 2, 1] * d2
        p2 = rot[k, 0, 2] * d0 + rot[k, 1, 2] * d1 + rot[k, 2, 2] * d2
        if derive:
            for i in range(3):
                m[i, 0], m[i, 1], m[i, 2] = rot[k, 0, i], rot[k, 1, i], rot[k, 2, i]
        s, uv_left, uv_right = 1.0 / rows.sigma[o], rows.uv_left[o], rows.uv_right[o]
        seen = project_one(cameras.model_l, cameras.params_l, p0, p1, p2)
        cost += _accumulate(seen, uv_left[0], uv_left[1], s, m, derive, h, b)
        if math.isfinite(uv_right[0]):
            if derive:
                for i in range(3):
                    for c in range(3):
                        m[i, c] = t[i, 0] * rot[k, c, 0] + t[i, 1] * rot[k, c, 1] + t[i, 2] * rot[k, c, 2]
            seen = project_one(cameras.model_r, cameras.params_r, *transform_point(t, p0, p1, p2))
            cost += _accumulate(seen, uv_right[0], uv_right[1], s, m, derive, h, b)
    return cost


@inner
def _copy(source, target):
    """Element by element: a slice assignment would take seconds to compile for the text of its error message."""
    for i in range(source.size):
        target.flat[i] = source.flat[i]


@njit
def refine_points(points, rays, origins, trials, starts, rot, pos, rows, cameras, steps):
    """Improves points (P, 3) in place.

    Args:
        rays, origins: (P, 3) unit first ray and its origin, world. trials: (T,) metres tried along it.
        starts: (P + 1,) first observation of each point. rot, pos: world_T_kf. rows: Seen. cameras: StereoCameras.
    """
    h, b = np.zeros((3, 3)), np.zeros(3)
    h2, b2, m = np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))
    x, y, damped, factor = np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(points.shape[0]):
        first, last = starts[i], starts[i + 1]
        lowest = math.inf
        for k in range(trials.shape[0] + 1):
            for j in range(3):
                y[j] = points[i, j] if k == 0 else origins[i, j] + rays[i, j] * trials[k - 1]
            if not math.isfinite(y[0]):
                continue
            cost = _cost(y, first, last, rot, pos, rows, cameras, lowest, False, m, h, b)
            if cost < lowest:
                lowest = cost
                _copy(y, x)
        if not math.isfinite(lowest):  # x is the point before it
            continue
        damping = 1e-3
        cost = _cost(x, first, last, rot, pos, rows, cameras, math.inf, True, m, h, b)
        for _ in range(steps):
            _copy(h, damped)
            for j in range(3):
                damped[j, j] += damping * h[j, j] + 1e-12
            if not solve_symmetric(damped, b, y, factor):
                break
            for j in range(3):
                y[j] += x[j]
            new = _cost(y, first, last, rot, pos, rows, cameras, cost, True, m, h2, b2)
            if new < cost:
                done = cost - new < 1e-4 * cost
                cost, damping = new, damping * 0.1
                _copy(y, x)
                _copy(h2, h)
                _copy(b2, b)
                if done:
                    break
            else:
                damping *= 10.0
        for j in range(3):
            points[i, j] = x[j]


def triangulate(map_: Map, rig: Rig, rows: I64) -> F64:
    """(N, 3) better positions of some points from all their observations; each must have at least one."""
    table, keyframes = map_.observations, map_.keyframes
    rows = np.asarray(rows, np.int64)
    obs, of = map_.sightings(rows)
    obs = obs[np.lexsort((obs, of))]  # point after point, oldest first
    starts = np.searchsorted(of, np.arange(len(rows) + 1))
    oldest = obs[starts[:-1]]
    pose = keyframes.map_T_kf[table.kf[oldest]]
    bearing = rig.left.unproject(table.uv_left[oldest].astype(float))
    rays = np.einsum("nij,nj->ni", pose[:, :3, :3], bearing)
    base = rig.baseline if rig.stereo else 0.05
    trials = 1.0 / np.linspace(1.0 / (NEAREST * base), 1.0 / (FARTHEST * base), TRIALS)
    kfs, kf_index = np.unique(table.kf[obs], return_inverse=True)
    points = map_.points.xyz[rows]
    seen = (column[obs].astype(float) for column in (table.uv_left, table.uv_right, table.sigma))
    refine_points(
        *(points, np.ascontiguousarray(rays), np.ascontiguousarray(pose[:, :3, 3]), trials, starts),
        *(np.ascontiguousarray(keyframes.map_T_kf[kfs, :3, :3]), np.ascontiguousarray(keyframes.map_T_kf[kfs, :3, 3])),
        *(Seen(kf_index, *seen), StereoCameras.of_any(rig), STEPS),
    )
    return points
