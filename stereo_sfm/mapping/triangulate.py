"""Triangulation of points from all their observations with fixed keyframes, as initial values of bundle adjustment.

A point's first depth comes from one stereo pair and may be far off (a fisheye sees points along its own baseline).
Distances along its first ray are tried from near to far, and the best is refined by Levenberg-Marquardt with a Cauchy
loss, each point with its own damping.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.mapping import bundle_kernels
from stereo_sfm.mapping.bundle import Bundle, BundleConfig, Linear, State, Table
from stereo_sfm.mapping.map import Map
from stereo_sfm.types import F64, I64

TRIALS = 8  # distances tried
NEAREST, FARTHEST = 4.0, 4000.0  # baselines (a rig with one camera: of 5 cm)
STEPS = 8  # of Levenberg-Marquardt at most
CONVERGED = 1e-4  # relative decrease of the cost that ends them
CAUCHY = 2.0  # sigmas, scale of the loss: a residual of so many counts half


def triangulate(map_: Map, rig: Rig, rows: I64) -> F64:
    """(N, 3) better positions of some points from all their observations; each must have at least one."""
    table, rows = map_.observations, np.asarray(rows, np.int64)
    obs, of = map_.sightings(rows)
    order = np.lexsort((obs, of))
    obs, of, x, count = obs[order], of[order], map_.points.xyz[rows], len(rows)
    kfs, kf = np.unique(table.kf[obs], return_inverse=True)
    poses, fixed = map_.keyframes.map_T_kf[kfs], np.ones(len(kfs), bool)
    uv_left, uv_right, sigma = (column[obs].astype(float) for column in (table.uv_left, table.uv_right, table.sigma))
    bundle = Bundle(poses, fixed, x, kf, of, uv_left, uv_right, np.repeat(sigma[:, None], 2, 1))
    problem = Table([rig], bundle, BundleConfig(), np.arange(len(obs)))
    problem.cauchy = CAUCHY
    rot, pos = np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3])

    def evaluate(points: F64) -> tuple[F64, Linear]:
        """Cost (N,) of each point, and models of the observations."""
        linear, _ = problem.linearize(State(rot, pos, points))
        loss = np.log1p(linear[3] / CAUCHY**2)
        return np.asarray(np.bincount(of, loss[:, 0] + loss[:, 1], count), np.float64), linear

    first = kf[problem.starts[:-1]]
    rays = np.einsum("nij,nj->ni", rot[first], rig.left.unproject(uv_left[problem.starts[:-1]]))
    base, best = rig.baseline if rig.stereo else 0.05, np.full(count, np.inf)
    trials = 1.0 / np.linspace(1.0 / (NEAREST * base), 1.0 / (FARTHEST * base), TRIALS)
    for candidate in (x, *(pos[first] + metres * rays for metres in trials)):
        cost = np.where(np.isfinite(candidate[:, 0]), evaluate(candidate)[0], np.inf)
        x, best = np.where((cost < best)[:, None], candidate, x), np.minimum(cost, best)
    damping, running, nothing = np.full(count, 1e-3), np.ones(count, bool), np.zeros((count, 6))
    cost, linear = evaluate(x)
    h, g = problem.sum_up(rot, linear)
    for _ in range(STEPS):
        inverse, b = h.copy(), g.copy()
        bundle_kernels.point_blocks(x, x, nothing, nothing, damping, inverse, b)
        y = x + (inverse[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3) @ b[:, :, None])[:, :, 0]
        new, linear = evaluate(y)
        better = running & (new < cost)
        running &= ~(better & (cost - new < CONVERGED * cost))
        problem.weights *= running[of][:, None]  # what has converged is projected no more
        damping *= np.where(better, 0.1, 10.0)
        for before, after in ((x, y), (cost, new), *zip((h, g), problem.sum_up(rot, linear), strict=True)):
            before[better] = after[better]
        if not running.any():
            break
    return x
