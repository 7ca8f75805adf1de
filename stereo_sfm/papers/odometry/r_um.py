"""R-Um: 3-point RANSAC for outliers, then Umeyama's least squares over the inliers (retail paper, V-A)."""

from __future__ import annotations

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.procrustes import refuse_line, rigid, rigid_ransac
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.papers.motion_estimator import (
    EstimatorEntry,
    FramePair,
    Motion,
    refuse_chance,
    thresholds,
    weights,
)


class RUm:
    """3D-3D alignment with outlier removal."""

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config

    def estimate(self, pair: FramePair, rng: np.random.Generator) -> Motion:
        """See `Estimator`."""
        config = self._config
        rows = np.flatnonzero(pair.both)
        if len(rows) < config.min_inliers:
            raise Degenerate("too_few_points", f"{len(rows)} matches have depth on both sides")
        source, target, sigmas = pair.points_last[rows], pair.points_now[rows], pair.sigmas[rows]
        consensus = rigid_ransac(source, target, thresholds(config, sigmas), rng, config.max_samples)
        chosen = consensus.inliers
        refuse_line(pair.bearings_last[rows[chosen]], 2 * config.epipolar_px * pair.pixel_rad)
        weight = weights(config, sigmas[chosen])
        now_T_last = rigid(source[chosen], target[chosen], weight)
        refuse_chance(se3.transform(now_T_last, source[chosen]), pair.bearings_now[rows[chosen]])
        inliers = np.zeros(len(pair.bearings_now), bool)
        inliers[rows[chosen]] = True
        return Motion(now_T_last[:3, :3], now_T_last[:3, 3], inliers)


ESTIMATOR = EstimatorEntry(
    "3-point RANSAC, then Umeyama (retail paper)", lambda config, camera: RUm(config), needs_depth=True
)
