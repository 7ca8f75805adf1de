"""Pose of one keyframe from fixed points: bundle adjustment of a single pose."""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.mapping.bundle import Bundle, BundleConfig, bundle_adjust
from stereo_sfm.types import F64, Bool


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
    rows, sigmas = np.arange(len(points)), np.repeat(np.asarray(sigma, float)[:, None], 2, axis=1)
    bundle = Bundle(
        np.array(world_T_cam, float)[None], np.zeros(1, bool), points, np.zeros_like(rows), rows, uv_left, uv_right,
        sigmas, points_stay=True,
    )  # fmt: skip
    result = bundle_adjust(rig, bundle, BundleConfig(rounds=3, huber=huber))
    return result.world_T_kf[0], result.inlier
