"""A keyframe for place recognition: the corners of its image and its map points, with descriptors.

Pixels can be those that another camera would have seen, so that places can be compared across cameras.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.loop import binary
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
        ids[rows], uv_left[rows], uv_right[rows], points[rows], own.range_sigmas(points[rows], disparity_sigma),
        descriptors[rows], corner[rows], rows,
    )  # fmt: skip


def seen_by(rig: Rig, own: Rig, uv_left: F64, uv_right: F64, points: F64) -> tuple[F64, F64]:
    """Pixels (N, 2) of left and right images as `rig` would have made them, NaN where it could not.

    The left pixel is moved along its ray. What the right pixel differs from the projection of its point stays.

    Args:
        own: the rig that made them; the same one changes nothing.
        points: (N, 3) metres in the left camera, NaN where unknown: there is no right pixel.
    """
    if own is rig:
        return uv_left, uv_right
    left, a, b = uv_left, rig.left, own.left
    if a.model_id != b.model_id or not np.array_equal(a.params, b.params):
        left = a.project(b.unproject(uv_left))
    if rig.right is None or own.right is None:
        return left, np.full_like(uv_right, np.nan)
    return left, rig.project_right(points) + (uv_right - own.project_right(points))


def widest(rigs: Iterable[Rig]) -> Rig:
    """The rig whose left camera sees widest, in which what all of them saw can be compared; of equals the first."""
    return max(rigs, key=_width)


def _width(rig: Rig) -> float:
    """Mean angle in radians between the optical axis and the middles of the left image's edges."""
    (w, h), x, y = rig.left.size, rig.left.cx, rig.left.cy
    z = rig.left.unproject(np.array([[0.0, y], [w - 1.0, y], [x, 0.0], [x, h - 1.0]]))[:, 2]
    return float(np.arccos(np.clip(np.nan_to_num(z, nan=-1.0), -1.0, 1.0)).mean())
