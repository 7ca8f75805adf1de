"""Which keyframe was the first after a sudden change of the rig (a knock)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.scene_model import inverse_distances
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.motion_only import refine_pose
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.types import F64, I64, Keyframe

MIN_POINTS = 20  # seen by both eyes in two successive keyframes
MATCH_PX = 0.3  # scale of the loss
FAR = 1e-3  # 1/m, of points without a measured distance


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """What is known of a keyframe without its images."""

    kf_id: int
    stamp_ns: int
    submap_id: int
    odom_T_cam: F64  # (4, 4)
    point_ids: I64  # (N,)
    uv_left: F64  # (N, 2) px
    uv_right: F64  # (N, 2) px, NaN where not seen

    @staticmethod
    def of(keyframe: Keyframe) -> SeenPoints:
        k = keyframe
        return SeenPoints(k.kf_id, k.stamp_ns, k.submap_id, k.odom_T_cam, k.point_ids, k.uv_left, k.uv_right)

    def every(self, step: int, first: int) -> SeenPoints:
        """With one in `step` of the points: those whose id is `first` modulo `step`."""
        kept = self.point_ids % step == first
        return replace(self, point_ids=self.point_ids[kept], uv_left=self.uv_left[kept], uv_right=self.uv_right[kept])


def first_changed(seen: Sequence[SeenPoints], before: Rig, after: Rig) -> int | None:
    """Id of the first keyframe of the rig `after`; None where one rig explains all of them as well.

    Between two keyframes of one rig, the points' distances in the first, as this rig measures them, predict the right
    pixels in the second. Where the rig changed in between, they do so with both rigs only.
    """
    if len(seen) < 2:
        return None
    pairs = list(itertools.pairwise(seen))
    each = [[_misfit(a, b, *rigs) for rigs in ((before, before), (before, after), (after, after))] for a, b in pairs]
    misfit = np.array(each)
    misfit[np.isnan(misfit).any(1)] = 0.0  # says nothing
    same, across, changed = misfit.T
    total = np.cumsum(same) - same + across + changed.sum() - np.cumsum(changed)
    best = int(np.argmin(total))
    return pairs[best][1].kf_id if total[best] < min(same.sum(), changed.sum()) else None


def _misfit(a: SeenPoints, b: SeenPoints, rig_a: Rig, rig_b: Rig) -> float:
    """Mean loss of the right pixels that two keyframes share, the distances measured in the first; NaN without many.

    The motion between them is solved with these distances: that of the odometry was measured with either rig.
    """
    _, i, j = np.intersect1d(a.point_ids, b.point_ids, assume_unique=True, return_indices=True)
    rho = inverse_distances(rig_a, a.uv_left[i], a.uv_right[i])
    good = np.isfinite(rho) & (rho > FAR) & np.isfinite(b.uv_right[j]).all(1)
    if good.sum() < MIN_POINTS:
        return np.nan
    i, j, rho = i[good], j[good], rho[good]
    points = rig_a.left.unproject(a.uv_left[i]) / rho[:, None]
    try:
        moved = refine_pose(
            points,
            rig_b.left.unproject(b.uv_left[j]),
            se3.inverse(b.odom_T_cam) @ a.odom_T_cam,
            MATCH_PX / rig_b.left.fx,
        )
    except Degenerate:
        return np.nan
    in_b = se3.transform(moved.cam_T_ref, points)
    off = rig_b.project_right(in_b) - b.uv_right[j]
    return float(np.nanmean(np.log1p((off**2).sum(1) / MATCH_PX**2)))
