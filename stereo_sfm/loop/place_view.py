"""A keyframe for place recognition: the corners of its image and its map points, with descriptors."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.loop import binary
from stereo_sfm.loop.other_camera import seen_by
from stereo_sfm.types import F64, I64, U8, Bool, Keyframe

KEPT = 64  # newest results, some megabytes: the same keyframes are candidates again and again


@dataclass(frozen=True, eq=False)
class PlaceView:
    """N pixels with descriptors: corners, by which a place is recognised, and points, which a loop associates."""

    ids: I64  # (N,) point ids; -1 for corners that are not map points
    uv_left: F64  # (N, 2) px
    uv_right: F64  # (N, 2) px, NaN where unseen
    points: F64  # (N, 3) metres in this camera, NaN where the depth is unknown
    sigmas: F64  # (N,) metres along the ray
    descriptors: U8  # (N, 32), none of them zero
    corner: Bool  # (N,) of `Keyframe.corners` or `Keyframe.sides`; False: a point
    rows: I64  # (N,) of a corner: its row there


@functools.lru_cache(maxsize=KEPT)
def place_view_of(
    keyframe: Keyframe, rig: Rig, disparity_sigma: float, sideways: bool = False, own: Rig | None = None
) -> PlaceView:
    """Corners of a keyframe (`sideways`: those of the views that face the shelves), then its points.

    Args:
        rig: whose pixels the view has. own: of the keyframe, None: the same. What `rig` could not see is left out.
    """
    own = own or rig
    c = keyframe.sides if sideways else keyframe.corners
    uv_left = np.concatenate([c.uv_left, keyframe.uv_left], dtype=np.float64)
    uv_right = np.concatenate([c.uv_right, keyframe.uv_right], dtype=np.float64)
    points = np.concatenate([c.points_cam, keyframe.points_cam], dtype=np.float64)
    descriptors = np.concatenate([c.descriptors, keyframe.descriptors])
    ids = np.concatenate([np.full(len(c), -1, np.int64), keyframe.point_ids])
    corner = np.arange(len(ids)) < len(c)
    uv_left, uv_right = seen_by(rig, own, uv_left, uv_right, points)
    rows = np.flatnonzero(binary.present(descriptors) & (own is rig or rig.left.inside(uv_left)))
    return PlaceView(
        ids[rows],
        uv_left[rows],
        uv_right[rows],
        points[rows],
        own.range_sigmas(points[rows], disparity_sigma),
        descriptors[rows],
        corner[rows],
        rows,
    )
