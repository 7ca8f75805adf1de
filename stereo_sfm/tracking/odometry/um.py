"""Um: Umeyama's least squares over all matches, without outlier removal (retail paper, V-A)."""

from __future__ import annotations

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry.procrustes import rigid
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.tracking.odometry.base import FramePair, Motion, weights


class Um:
    """3D-3D alignment of everything that was matched: the papers' baseline."""

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config

    def estimate(self, pair: FramePair, rng: np.random.Generator) -> Motion:
        """See `Estimator`."""
        rows = pair.both
        if rows.sum() < self._config.min_inliers:
            raise Degenerate("too_few_points", f"{int(rows.sum())} matches have depth on both sides")
        weight = weights(self._config, pair.sigmas[rows])
        now_T_last = rigid(pair.points_last[rows], pair.points_now[rows], weight)
        return Motion(now_T_last[:3, :3], now_T_last[:3, 3], rows)
