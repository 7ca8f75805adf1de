"""Changes of the map after a correction of the rig: observations from before a step, and positions of points."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.scene_model import inverse_distances
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.map import Map
from stereo_sfm.mapping.triangulate import triangulate
from stereo_sfm.types import I64, Corners


def recalibrate(map_: Map, rigs: Sequence[tuple[int, Rig]]) -> None:
    """Move points and corners to their positions with the last rig; poses stay for the bundle adjustment that must
    follow.

    Args:
        map_: changed in place.
        rigs: first keyframe rows, ascending, and the rig from each of them on. Observations of earlier ones are
            rewritten as the last one would have made them, so that one rig is valid for the whole map.
    """
    after = rigs[-1][1]
    for (first, before), (until, _) in pairwise(rigs):
        _rewrite(map_, before, after, first, until)
    firsts = [first for first, _ in rigs]
    for row, seen in map_.corners.items():
        before = rigs[max(bisect_right(firsts, row) - 1, 0)][1]
        map_.corners[row] = _placed(seen[0], before, after), _placed(seen[1], before, after)
    rows = map_.living_points()
    rows = rows[map_.points.obs_count[rows] > 0]
    map_.move_points(rows, triangulate(map_, after, rows))


def _placed(corners: Corners, before: Rig, after: Rig) -> Corners:
    """Corners that the rig `before` saw as the other one would have seen them; without a match they stay."""
    left, right, points = (np.asarray(a, np.float64) for a in (corners.uv_left, corners.uv_right, corners.points_cam))
    moved = right + (after.project_right(points) - before.project_right(points))
    rho = inverse_distances(after, left, moved)
    good = np.isfinite(rho) & (rho > 0)
    now = after.left.unproject(left[good]) / rho[good, None]
    uv_right, points_cam = corners.uv_right.copy(), corners.points_cam.copy()
    uv_right[good], points_cam[good] = moved[good], now
    return Corners(corners.uv_left, uv_right, points_cam, corners.descriptors)


def _rewrite(map_: Map, before: Rig, after: Rig, first: int, until: int) -> None:
    """Move right pixels of the keyframes in these rows to their projections by the other rig; residuals stay."""
    table = map_.observations
    inside = (table.kf >= first) & (table.kf < until)
    obs: I64 = np.flatnonzero((table.pt >= 0) & inside & np.isfinite(table.uv_right[:, 0]))
    poses = se3.inverse(map_.keyframes.map_T_kf[table.kf[obs]])
    points = map_.points.xyz[table.pt[obs]]
    in_left = (poses[:, :3, :3] @ points[..., None])[..., 0] + poses[:, :3, 3]
    was = before.project_right(in_left)
    now = after.project_right(in_left)
    table.uv_right[obs] = (table.uv_right[obs] + (now - was)).astype(table.uv_right.dtype)
