"""Points around a keyframe, its own and those of connected keyframes, for matching with a camera's view."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.hamming import as_words, hamming
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.geometry.pixel_grid import cells_near, make_grid
from stereo_sfm.loop.place_view import PlaceView, place_view_of
from stereo_sfm.types import F64, I64, Keyframe

SAME_CORNER_PX = 4.0  # largest difference of one corner in two keyframes, of positions by stereo
CLOUD_KEYFRAMES = 4  # connected keyframes whose points are added to a place's own: on both sides of it


@dataclass(frozen=True, eq=False)
class Cloud(PlaceView):
    """M rows of several views with `points` in the frame of a centre camera; all else is of the row's own keyframe.

    A physical point may have several rows, with the same id; that of a corner which is no map point is negative.
    """

    view: I64  # (M,) the row's own keyframe: row of centre_T_kf
    centre_T_kf: F64  # (V, 4, 4); row 0 is the centre

    def seen_by_centre(self, rows: I64) -> tuple[F64, F64]:
        """Left and right pixels (N, 2) of these rows in the centre's image, NaN for views of other keyframes."""
        own = (self.view[rows] == 0)[:, None]
        return np.where(own, self.uv_left[rows], np.nan), np.where(own, self.uv_right[rows], np.nan)


def gather(
    centre: Keyframe,
    others: Sequence[Keyframe],
    rig: Rig,
    disparity_sigma: float,
    sideways: bool = False,
    own: Sequence[Rig] = (),
) -> Cloud:
    """Corners and points of the centre, then of `others` (near in time), transformed into its camera by odometry.

    Rows without depth are left out. `sideways`: the corners are those of the views that face the shelves.
    Corners of several keyframes with about the same position and descriptor share an id. Pixels are those of `rig`;
    `own`: the rigs of the centre and of the others, where they have other ones.
    """
    keyframes = [centre, *others]
    centre_T_kf = np.stack([se3.inverse(centre.odom_T_cam) @ k.odom_T_cam for k in keyframes])
    rigs = own or [rig] * len(keyframes)
    views = [place_view_of(k, rig, disparity_sigma, sideways, o) for k, o in zip(keyframes, rigs, strict=True)]
    columns = {f.name: np.concatenate([getattr(view, f.name) for view in views]) for f in fields(PlaceView)}
    deep = np.flatnonzero(np.isfinite(columns["points"][:, 2]))
    view = np.repeat(np.arange(len(views)), [len(view.ids) for view in views]).take(deep)
    cloud = Cloud(**{name: c.take(deep, axis=0) for name, c in columns.items()}, view=view, centre_T_kf=centre_T_kf)
    ends = np.searchsorted(view, np.arange(len(views) + 1))
    for t, first, end in zip(centre_T_kf, ends[:-1], ends[1:], strict=True):
        cloud.points[first:end] = se3.transform(t, cloud.points[first:end])
    cloud.ids[cloud.corner] = _name_corners(views, cloud, rig)
    return cloud


def _name_corners(views: Sequence[PlaceView], cloud: Cloud, rig: Rig) -> I64:
    """Negative ids of a cloud's corners: a keyframe's corner that matches one before it has that one's."""
    rows = np.flatnonzero(cloud.corner)
    ends = np.searchsorted(cloud.view[rows], np.arange(len(views)), side="right")
    points, words, kinds = cloud.points[rows], as_words(cloud.descriptors[rows]), np.ones(len(rows), bool)
    ids, named = np.empty(len(rows), np.int64), 0
    for k, view in enumerate(views):
        count = int(view.corner.sum())  # they come first
        names, before = -1 - named - np.arange(count), ends[k - 1] if k else 0
        named += count
        if before:
            uv = rig.left.project(se3.transform(se3.inverse(cloud.centre_T_kf[k]), points[:before]))
            best = _nearest_within(
                view.uv_left[:count], as_words(view.descriptors[:count]), view.corner[:count],
                uv, words[:before], kinds[:before], SAME_CORNER_PX, MapperConfig.match_distance_bits,
            )  # fmt: skip
            matched = np.flatnonzero(best >= 0)
            known, first = np.unique(ids[best[matched]], return_index=True)
            names[matched[first]] = known
        ids[before : ends[k]] = names[np.isfinite(view.points[:count, 2])]
    return ids


def match_guided(
    b_T_a: F64, view: PlaceView, cloud: Cloud, rig: Rig, max_distance: int, radius: float
) -> tuple[I64, I64]:
    """Pairs (rows of view, rows of cloud) whose descriptors agree within `radius` px of the projection, one to one.

    Corners are paired with corners, other points with other points.
    """
    uv = rig.left.project(se3.transform(b_T_a, cloud.points))
    words_b, words_a = as_words(view.descriptors), as_words(cloud.descriptors)
    best = _nearest_within(view.uv_left, words_b, view.corner, uv, words_a, cloud.corner, radius, max_distance)
    rows_b = np.flatnonzero(best >= 0)
    return rows_b, best[rows_b].astype(np.int64)


@njit
def _nearest_within(uv_b, words_b, kind_b, uv_a, words_a, kind_a, radius, max_distance):
    """For every row of b the row of a of its kind with the nearest descriptor within the radius, if that is mutual.

    Ties go to the lower row.
    """
    n, m = uv_b.shape[0], uv_a.shape[0]
    best = np.full(n, -1, np.int32)
    low = np.full(n, max_distance + 1, np.int32)
    best_a = np.full(m, -1, np.int32)
    low_a = np.full(m, max_distance + 1, np.int32)
    frame, shape, starts, members = make_grid(uv_b, radius)
    for j in range(m):
        if not math.isfinite(uv_a[j, 0]):
            continue
        left, right, top, bottom = cells_near(uv_a[j, 0], uv_a[j, 1], frame, shape)
        for line in range(top, bottom if left < right else top):
            for at in range(starts[line * shape[0] + left], starts[line * shape[0] + right]):
                i = members[at]
                d = hamming(words_b, i, words_a, j)  # first: that hardly any passes is foreseen
                if d > max_distance or kind_b[i] != kind_a[j]:
                    continue
                if abs(uv_b[i, 0] - uv_a[j, 0]) > radius or abs(uv_b[i, 1] - uv_a[j, 1]) > radius:
                    continue
                if d < low[i]:
                    low[i] = d
                    best[i] = j
                if d < low_a[j] or (d == low_a[j] and i < best_a[j]):
                    low_a[j] = d
                    best_a[j] = i
    for i in range(n):
        if best[i] >= 0 and best_a[best[i]] != i:
            best[i] = -1
    return best
