"""Second step of the two-step methods: translation for a known rotation (retail paper, section III-B)."""

from __future__ import annotations

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry.procrustes import translation_ransac
from stereo_sfm.papers.motion_estimator import FramePair, thresholds, weights
from stereo_sfm.types import F64, Bool


def translation_for(
    rotation: F64, pair: FramePair, config: OdometryConfig, rng: np.random.Generator
) -> tuple[F64, Bool]:
    """Translation (3,) metres and the inlier rows (N,) of the pair, by 1-point RANSAC and least squares.

    Raises:
        Degenerate: "too_few_points" without enough points on both sides, else as `translation_ransac`.
    """
    rows = pair.rows_with_points(config.min_inliers)
    sigmas = pair.sigmas[rows]
    translation, consensus = translation_ransac(
        pair.points_last[rows] @ rotation.T, pair.points_now[rows], thresholds(config, sigmas), rng,
        weights(config, sigmas),
    )  # fmt: skip
    return translation, pair.marked(rows[consensus.inliers])
