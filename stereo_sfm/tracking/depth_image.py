"""Depth images as the observations of a second camera."""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.types import F32, F64, Bool

DEPTH_STEP = 0.04  # relative depth difference around a pixel that counts as an edge


@np.errstate(invalid="ignore")
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
    dv, du = np.mgrid[-2:3, -2:3][..., None]
    window = depth[v + dv, u + du]
    around = window[1:4, 1:4].reshape(9, -1)
    good = inside & _smooth(around)
    if 2 * good.sum() < inside.sum() and (more := inside & _smooth(closed := _closed(window))).sum() > 2 * good.sum():
        around, good = closed, more  # most holes are the sensor's grid
    bearing = rig.left.unproject(uv[good])
    points, uv_right = np.full((len(uv), 3), np.nan), np.full(uv.shape, np.nan)
    points[good] = bearing / bearing[:, 2:] * around.mean(0)[good, None]
    uv_right[good] = rig.project_right(points[good])
    return points, uv_right


def _smooth(around: F32) -> Bool:
    """(N,) whether (9, N) metres around a pixel have neither a hole nor an edge."""
    return (around[4] > 0) & (np.ptp(around, axis=0) < DEPTH_STEP * around[4])


def _closed(window: F32) -> F32:
    """(5, 5, N) metres -> the inner (9, N); a hole between two pixels that agree has their mean, at an edge none."""
    inner, mean = window[1:4, 1:4], np.full_like(window[1:4, 1:4], np.nan)
    for dv, du in ((1, -1), (1, 1), (0, 1), (1, 0)):
        one, other = window[1 + dv : 4 + dv, 1 + du : 4 + du], window[1 - dv : 4 - dv, 1 - du : 4 - du]
        agree = (one > 0) & (other > 0) & (np.abs(one - other) < DEPTH_STEP * one)
        mean = np.where(agree, 0.5 * (one + other), mean)
    return np.where(inner > 0, inner, mean).reshape(9, -1)
