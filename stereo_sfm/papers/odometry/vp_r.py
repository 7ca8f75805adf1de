"""VP-R: rotation from the vanishing points of two frames, translation by 1-point RANSAC (retail paper, III-A2, III-B).

Works on great circles, hence on fisheye images too. The vanishing points give each camera's orientation up to the 24
turns of a cube; between two frames the smallest of the 24 relative rotations is the motion.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.config import OdometryConfig
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.lines import LineDetector
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.geometry.vanishing import Manhattan, estimate
from stereo_sfm.papers.motion_estimator import EstimatorEntry, FramePair, Motion
from stereo_sfm.papers.odometry._translation import translation_for
from stereo_sfm.types import U8


class VpR:
    """Declines ("weak_structure", "too_few_lines") when either frame does not show three directions well."""

    def __init__(self, config: OdometryConfig, camera: Camera) -> None:
        self._config = config
        self._lines = LineDetector(camera)
        self._known: dict[int, Manhattan] = {}  # orientation of the last frames, by frame id

    def __call__(self, pair: FramePair, rng: np.random.Generator) -> Motion:
        """Motion of a pair."""
        last = self._orientation(pair.frame_id_last, pair.image_last, None)
        now = self._orientation(pair.frame_id_now, pair.image_now, last)
        self._known = {pair.frame_id_last: last, pair.frame_id_now: now}
        rotation = now.cam_R_axes @ last.cam_R_axes.T
        if np.trace(rotation) < 1 + 2 * np.cos(np.radians(45.0)):
            raise Degenerate("ambiguous_turn", "more than 45 degrees between two frames")
        translation, inliers = translation_for(rotation, pair, self._config, rng)
        stats = {"line_share": now.share, "vp_sigma_deg": float(np.degrees(now.sigma))}
        return Motion(rotation, translation, inliers, stats=stats)

    def _orientation(self, frame_id: int, image: U8, near: Manhattan | None) -> Manhattan:
        if frame_id in self._known:
            return self._known[frame_id]
        expected, rng = None if near is None else near.cam_R_axes, np.random.default_rng(frame_id)
        return estimate(self._lines.detect(image), rng, expected=expected)


ESTIMATOR = EstimatorEntry("vanishing points, then 1-point translation (retail paper)", VpR, needs_depth=True)
