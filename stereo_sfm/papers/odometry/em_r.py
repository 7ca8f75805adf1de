"""EM-R: rotation from the five-point essential matrix, translation by 1-point RANSAC (retail paper, III-A1, III-B)."""

from __future__ import annotations

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry.essential import relative_pose
from stereo_sfm.papers.motion_estimator import EstimatorEntry, FramePair, Motion
from stereo_sfm.papers.odometry._translation import translation_for


class EmR:
    """Where a rotation alone explains the matches (a standing or turning camera), that rotation is used."""

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config

    def estimate(self, pair: FramePair, rng: np.random.Generator) -> Motion:
        """See `Estimator`."""
        config = self._config
        pose = relative_pose(
            pair.bearings_last,
            pair.bearings_now,
            config.epipolar_px * pair.pixel_rad,
            rng,
            refine=config.refine,
            max_samples=config.max_samples,
            need_direction=False,
        )
        translation, inliers = translation_for(pose.rotation, pair, config, rng)
        stats = {"parallax_deg": float(np.degrees(pose.parallax)), "pure_rotation": float(pose.pure_rotation)}
        return Motion(pose.rotation, translation, inliers & pose.inliers, stats=stats)


ESTIMATOR = EstimatorEntry(
    "essential matrix, then 1-point translation (retail paper)", lambda config, camera: EmR(config), needs_depth=True
)
