"""Second step of the two-step methods: translation for a known rotation (retail paper, section III-B)."""

from __future__ import annotations

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry.procrustes import translation_ransac
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.papers.motion_estimator import FramePair, thresholds, weights
from stereo_sfm.types import F64, Bool


def translation_for(
    rotation: F64, pair: FramePair, config: OdometryConfig, rng: np.random.Generator
) -> tuple[F64, Bool]:
    """Translation (3,) metres and the inlier rows (N,) of the pair, by 1-point RANSAC and least squares.

    Raises:
        Degenerate: "too_few_points" without enough points on both sides, else as `translation_ransac`.
    """
    rows = np.flatnonzero(pair.both)
    if len(rows) < config.min_inliers:
        raise Degenerate("too_few_points", f"{len(rows)} matches have depth on both sides")
    sigmas = pair.sigmas[rows]
    translation, consensus = translation_ransac(
        pair.points_last[rows] @ rotation.T,
        pair.points_now[rows],
        thresholds(config, sigmas),
        rng,
        weights(config, sigmas),
    )
    inliers = np.zeros(len(pair.bearings_now), bool)
    inliers[rows[consensus.inliers]] = True
    return translation, inliers
