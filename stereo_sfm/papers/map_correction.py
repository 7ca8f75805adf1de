"""Corrections by the map of a tracker whose odometry continues from the newest keyframe's pose in the map."""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, MapUpdate


class KeyframePoses:
    """Where the tracker has its keyframes whose update is still to come (the mapper expects its update applied)."""

    def __init__(self) -> None:
        self._odom_T_kf: dict[int, F64] = {}

    def add(self, kf_id: int, odom_T_kf: F64) -> None:
        """A new keyframe (4, 4)."""
        self._odom_T_kf[kf_id] = odom_T_kf

    def pose(self, kf_id: int) -> F64:
        """(4, 4) odom_T_kf; identity for one that is not known."""
        return self._odom_T_kf.get(kf_id, np.eye(4))

    def correct(self, update: MapUpdate) -> F64 | None:
        """(4, 4) by which all poses in the odometry frame are to be moved; None where the update knows none of them."""
        known = [k for k in update.kf_ids.tolist() if k in self._odom_T_kf]
        if not known:
            return None
        newest = max(known)
        row = int(np.flatnonzero(update.kf_ids == newest)[0])
        after = se3.inverse(update.map_T_odom) @ update.map_T_kf[row]
        moved = after @ se3.inverse(self._odom_T_kf[newest])
        self._odom_T_kf = {k: moved @ pose for k, pose in self._odom_T_kf.items() if k >= newest}
        return moved
