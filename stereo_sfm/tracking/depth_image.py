"""Depth images as the observations of a second camera."""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.types import F32, F64

DEPTH_STEP = 0.04  # relative depth difference around a pixel that counts as an edge


def points_from_depth(rig: Rig, depth: F32, uv: F64) -> tuple[F64, F64]:
    """What pixels of the left camera see, and where the rig's virtual right camera would see it.

    Args:
        depth: (H, W) metres along the left optical axis. uv: (N, 2) px.

    Returns:
        points (N, 3) metres in the left camera, right pixels (N, 2); NaN where the depth has a hole or an edge.
    """
    inside = rig.left.inside(uv, 2.0)
    u = np.where(inside, np.rint(uv[:, 0]), 2).astype(np.int64)
    v = np.where(inside, np.rint(uv[:, 1]), 2).astype(np.int64)
    around = np.stack([depth[v + dy, u + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    with np.errstate(invalid="ignore"):
        smooth = np.ptp(around, axis=0) < DEPTH_STEP * around[4]
    good = inside & smooth & (around[4] > 0)
    bearing = rig.left.unproject(uv[good])
    points, uv_right = np.full((len(uv), 3), np.nan), np.full(uv.shape, np.nan)
    points[good] = bearing / bearing[:, 2:] * around.mean(0)[good, None]
    uv_right[good] = rig.project_right(points[good])
    return points, uv_right
