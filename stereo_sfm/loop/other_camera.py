"""Pixels of one camera as another one would have seen them, so that places can be compared across cameras."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.types import F64


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
