"""Online check of the calibration: distances of stereo matches from their epipolar curves by region, and their trend.

Noise is symmetric, so the median of a region is the calibration's error there. The difference of a fast and a slow
average over the keyframes shows whether it grows. Errors of disparity are not visible (`calibration.self_calibration`
estimates them too).
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry.order_statistics import median
from stereo_sfm.geometry.stereo import epipolar_angle
from stereo_sfm.types import F64, Keyframe, RowErrors

GRID = (3, 4)  # rows and columns of regions: a turn of a camera and an error of its lens look different in them
SHARES = np.array([0.2, 0.04])  # weight of the newest keyframe in the averages: over about 5 and 25 keyframes
MIN_MATCHES = 5  # of a region, whose median two wrong ones then do not decide
# Of the systematic part, the larger one of the two: matches are lost from 1 px on, and the same small turn of a camera
# is many pixels of a long lens. Half a pixel is 0.05 degrees at a focal length of 573 px.
WARN_PX, WARN_DEG = 0.5, 0.05


class RowMonitor:
    """Row errors of the keyframes of a run, in order."""

    def __init__(self, rig: Rig) -> None:
        """`rig`: two cameras."""
        self.use(rig)

    def use(self, rig: Rig) -> None:
        """Start again with another rig."""
        self._rig = rig
        self._averages: F64 = np.full((len(SHARES), *GRID), np.nan)  # fast and slow

    def add(self, keyframe: Keyframe) -> RowErrors:
        """The averages after this keyframe."""
        now, before, share = self._regions(keyframe), self._averages, SHARES[:, None, None]
        mixed = np.where(np.isnan(before), now, (1 - share) * before + share * now)
        self._averages = np.where(np.isnan(now), before, mixed)
        systematic, earlier = _size(self._averages[0]), _size(self._averages[1])
        return RowErrors(
            keyframe.kf_id, keyframe.stamp_ns, self._averages[0].ravel().copy(), systematic, systematic - earlier,
            systematic > max(WARN_PX, self._rig.left.fx * np.deg2rad(WARN_DEG)),
        )  # fmt: skip

    def _regions(self, keyframe: Keyframe) -> F64:
        """Median row error of one keyframe by region, NaN where it has few matches."""
        assert self._rig.right is not None
        seen = np.isfinite(keyframe.uv_left).all(1) & np.isfinite(keyframe.uv_right).all(1)
        uv = keyframe.uv_left[seen]
        bearings = self._rig.left.unproject(uv), self._rig.right.unproject(keyframe.uv_right[seen])
        error = self._rig.left.fx * epipolar_angle(*bearings, self._rig.left_T_right)
        cell = np.clip((uv * GRID[::-1] / self._rig.left.size).astype(int), 0, np.array(GRID[::-1]) - 1)
        region = np.where(np.isfinite(error), cell[:, 1] * GRID[1] + cell[:, 0], -1)
        out = np.full(GRID[0] * GRID[1], np.nan)
        for k in range(len(out)):
            here = error[region == k]
            if len(here) >= MIN_MATCHES:
                out[k] = median(here)
        return out.reshape(GRID)


def _size(regions: F64) -> float:
    """Root mean square over the regions with matches; 0 without any."""
    known = regions[np.isfinite(regions)]
    return float(np.sqrt((known**2).mean())) if len(known) else 0.0
