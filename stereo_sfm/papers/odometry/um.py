"""Um: Umeyama's least squares over all matches, without outlier removal (retail paper, V-A)."""

from __future__ import annotations

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.procrustes import refuse_line, rigid
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.papers.motion_estimator import EstimatorEntry, FramePair, Motion, refuse_chance, weights


class Um:
    """3D-3D alignment of everything that was matched: the papers' baseline."""

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config

    def estimate(self, pair: FramePair, rng: np.random.Generator) -> Motion:
        """See `Estimator`."""
        rows = pair.both
        if rows.sum() < self._config.min_inliers:
            raise Degenerate("too_few_points", f"{int(rows.sum())} matches have depth on both sides")
        refuse_line(pair.bearings_last[rows], 2 * self._config.epipolar_px * pair.pixel_rad)
        source, target = pair.points_last[rows], pair.points_now[rows]
        now_T_last = rigid(source, target, weights(self._config, pair.sigmas[rows]))
        refuse_chance(se3.transform(now_T_last, source), pair.bearings_now[rows])
        return Motion(now_T_last[:3, :3], now_T_last[:3, 3], rows)


ESTIMATOR = EstimatorEntry(
    "Umeyama over all matches (retail paper)", lambda config, camera: Um(config), needs_depth=True
)
