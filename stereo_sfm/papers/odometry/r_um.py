"""R-Um: 3-point RANSAC for outliers, then Umeyama's least squares over the inliers (retail paper, V-A)."""

from __future__ import annotations

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry.procrustes import rigid_ransac
from stereo_sfm.papers.motion_estimator import EstimatorEntry, FramePair, Motion, thresholds
from stereo_sfm.papers.odometry.um import align


def _estimate(config: OdometryConfig, pair: FramePair, rng: np.random.Generator) -> Motion:
    rows = pair.rows_with_points(config.min_inliers)
    limits = thresholds(config, pair.sigmas[rows])
    consensus = rigid_ransac(pair.points_last[rows], pair.points_now[rows], limits, rng, config.max_samples)
    return align(config, pair, rows[consensus.inliers])


ESTIMATOR = EstimatorEntry.of("3-point RANSAC, then Umeyama (retail paper)", _estimate, needs_depth=True)
