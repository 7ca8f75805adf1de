"""Um: Umeyama's least squares over all matches, without outlier removal: the papers' baseline (retail paper, V-A)."""

from __future__ import annotations

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.procrustes import refuse_line, rigid
from stereo_sfm.papers.motion_estimator import EstimatorEntry, FramePair, Motion, refuse_chance, weights
from stereo_sfm.types import I64


def align(config: OdometryConfig, pair: FramePair, rows: I64) -> Motion:
    """3D-3D alignment of rows with points on both sides.

    Raises:
        Degenerate: bearings on a line, or no better than chance.
    """
    refuse_line(pair.bearings_last[rows], 2 * config.epipolar_px * pair.pixel_rad)
    now_T_last = rigid(pair.points_last[rows], pair.points_now[rows], weights(config, pair.sigmas[rows]))
    refuse_chance(se3.transform(now_T_last, pair.points_last[rows]), pair.bearings_now[rows])
    return Motion(now_T_last[:3, :3], now_T_last[:3, 3], pair.marked(rows))


def _estimate(config: OdometryConfig, pair: FramePair, rng: np.random.Generator) -> Motion:
    return align(config, pair, pair.rows_with_points(config.min_inliers))


ESTIMATOR = EstimatorEntry.of("Umeyama over all matches (retail paper)", _estimate, needs_depth=True)
