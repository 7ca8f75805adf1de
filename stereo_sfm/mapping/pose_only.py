"""Pose of one keyframe from fixed points: the cost of bundle adjustment for a single pose, in one compiled loop."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.geometry.se3_kernels import compose_into, exp_into
from stereo_sfm.geometry.small_matrix import solve_symmetric
from stereo_sfm.mapping.bundle import BundleConfig
from stereo_sfm.mapping.bundle_kernels import Rows, linearize, pose_blocks
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.types import F64, Bool

SETTINGS = BundleConfig(rounds=3)


@njit
def _model(pose, points, rows, use, limit, cameras, huber, lin):
    """`linearize` of all points from one pose (4, 4); the cost."""
    rot, pos = np.empty((1, 3, 3)), np.empty((1, 3))
    for i in range(3):
        pos[0, i] = pose[i, 3]
        for k in range(3):
            rot[0, i, k] = pose[i, k]
    trust = np.ones(points.shape[0])
    return linearize(rot, pos, points, rows, trust, use, limit, cameras, huber, False, False, lin)


@njit
def _descend(pose, points, rows, use, cameras, settings, lin, other):
    """Levenberg-Marquardt on pose (4, 4), in place, without outliers from the second round on.

    Returns:
        (M, 2) squared normalised residuals in the end.
    """
    huber, rounds, iterations, outlier_chi2, first_damping, tolerance = settings
    free, delta, trial = np.zeros(1, np.int64), np.zeros((4, 4)), np.zeros((4, 4))
    h, b, xi, factor = np.zeros((1, 6, 6)), np.zeros((1, 6)), np.zeros(6), np.zeros((6, 6))
    for index in range(rounds):
        limit = outlier_chi2 if index > 0 else 0.0
        cost = _model(pose, points, rows, use, limit, cameras, huber, lin)
        damping, accepted = first_damping, 0
        while accepted < iterations:
            for i in range(6):
                b[0, i] = 0.0
                for k in range(6):
                    h[0, i, k] = 0.0
            pose_blocks(rows.kf, free, lin, h, b)
            for i in range(6):
                h[0, i, i] += damping * h[0, i, i] + 1e-12
            if not solve_symmetric(h[0], b[0], xi, factor):
                break
            exp_into(xi, 1.0, delta)
            compose_into(pose, delta, trial)
            new = _model(trial, points, rows, use, 0.0, cameras, huber, other)
            if not new <= cost:
                damping *= 10.0
                if damping > 1e6 or new - cost <= 0.1 * tolerance * cost:
                    break
                continue
            done = cost - new <= tolerance * cost
            cost, damping, accepted = new, max(0.1 * damping, 1e-9), accepted + 1
            lin, other = other, lin
            for i in range(3):
                for k in range(4):
                    pose[i, k] = trial[i, k]
            if done:
                break
    return lin[3]


def adjust_pose(
    rig: Rig, world_T_cam: F64, points: F64, uv_left: F64, uv_right: F64, sigma: F64, huber: float
) -> tuple[F64, Bool]:
    """The pose that minimises the robust reprojection error in both images.

    Args:
        world_T_cam: (4, 4) start. points: (N, 3) world. uv_left, uv_right: (N, 2) px, NaN where unseen; only the row
            NaN: the column alone counts. sigma: (N,) px. huber: sigmas where the loss turns linear.

    Returns:
        (4, 4) pose, and (N, 2) which observations agree with it, in the left and the right image.
    """
    count, pose, s = len(points), np.array(world_T_cam, float), SETTINGS
    seen = np.stack([np.isfinite(uv_left).all(1), np.isfinite(uv_right[:, 0]) & rig.stereo], 1)
    weights = np.where(seen, 1.0 / np.asarray(sigma, float)[:, None], 0.0)
    uv = np.ascontiguousarray(uv_left, float), np.ascontiguousarray(uv_right, float)
    rows = Rows(np.zeros(count, np.int64), np.arange(count), *uv, weights)
    lin, other = (
        (np.empty((count, 6)), np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 2))) for _ in range(2)
    )
    chi2 = _descend(
        *(pose, np.ascontiguousarray(points, float), rows, seen.copy(), StereoCameras.of_any(rig)),
        *((float(huber), s.rounds, s.iterations, s.outlier_chi2, s.damping, s.tolerance), lin, other),
    )
    return se3.orthonormalize(pose), seen & (chi2 <= s.outlier_chi2)
