"""EM-R: rotation from the five-point essential matrix, translation by 1-point RANSAC (retail paper, III-A1, III-B).

Where a rotation alone explains the matches (a standing or turning camera), that rotation is used.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.papers.motion_estimator import EstimatorEntry, FramePair, Motion
from stereo_sfm.papers.odometry._translation import translation_for
from stereo_sfm.papers.odometry.eight_point import motion_of_rays


def _estimate(config: OdometryConfig, pair: FramePair, rng: np.random.Generator) -> Motion:
    pose, stats = motion_of_rays(config, pair, rng, need_direction=False)
    translation, inliers = translation_for(pose.rotation, pair, config, rng)
    return Motion(pose.rotation, translation, inliers & pose.inliers, stats=stats)


ESTIMATOR = EstimatorEntry.of("essential matrix, then 1-point translation (retail paper)", _estimate, needs_depth=True)
