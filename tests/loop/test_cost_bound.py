"""The bound of a pose's cost against the cost itself, which it stands for where that decides nothing."""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.loop.absolute_pose import CHI2_2DOF_95
from stereo_sfm.loop.cost_bound import SLACK, fisheye_bound, make_columns
from stereo_sfm.loop.p3p import Lens, squared_error
from tests.synthetic import fisheye_rig


@njit
def cost(t, points, sigmas, uv, lens, limit):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(points.shape[0]):
        if np.isfinite(points[i, 0]) and np.isfinite(uv[i, 0]):
            total += min(squared_error(t, points[i], sigmas[i], uv[i], lens), limit)
    return total


def test_the_bound_is_the_cost_but_for_rounding() -> None:
    camera, rng = fisheye_rig().left, np.random.default_rng(0)
    below, tight = [], 0
    for _ in range(2000):
        b_T_a = se3.exp(rng.normal(size=6) * [1, 1, 1, 0.7, 0.7, 0.7] * rng.choice([0.01, 1.0]))
        points = rng.normal(size=(40, 3)) * rng.choice([0.1, 1.0, 5.0])
        uv = camera.project(se3.transform(b_T_a, points)) + rng.normal(size=(40, 2)) * rng.choice([1.0, 30.0])
        points[0], points[1], uv[2] = se3.inverse(b_T_a)[:3, 3] + b_T_a[2, :3] * rng.normal(), np.nan, np.nan
        sigmas = rng.uniform(0.001, 1.0, 40)
        t, sigma = np.ascontiguousarray(b_T_a[:3]), rng.choice([0.3, 1.0])
        exact = cost(t, points, sigmas, uv, Lens(camera.model_id, camera.params, sigma), CHI2_2DOF_95)
        bound = fisheye_bound(t, make_columns(points, sigmas, uv), camera.params, sigma, CHI2_2DOF_95)
        below.append(exact - bound)
        tight += exact < 30 * CHI2_2DOF_95
    assert min(below) > -SLACK / 10
    assert np.mean(np.array(below) < SLACK) > 0.99 and tight > 500
