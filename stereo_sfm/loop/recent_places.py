"""Relocalization in the newest keyframes after a short loss of tracking, by the descriptors of their corners."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import LoopConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop.absolute_pose import ransac_pose, refine_pose
from stereo_sfm.loop.cloud import Cloud, gather, match_guided
from stereo_sfm.loop.place_view import PlaceView, place_view_of
from stereo_sfm.loop.verification import pair
from stereo_sfm.types import F64, Keyframe

NEWEST_KEYFRAMES = 12  # searched: where a camera can be after a short loss
NEAREST = 2  # keyframes that are matched, of the most similar views, and others whose points are added to each one's
# Radius of the search, as shares of the image's width. The last is the whole image, whatever is expected.
WINDOWS = 0.05, 0.12, 0.3, 1.0
MIN_INLIERS = 12  # and half of the matched corners: a hypothesis, which tracking verifies


class RecentPlaces:
    """Finds the camera of a keyframe among the newest keyframes of the same odometry (tracking.protocol.Places)."""

    def __init__(self, config: LoopConfig, rig: Rig) -> None:
        self._config, self._rig = config, rig
        self._keyframes: deque[Keyframe] = deque(maxlen=NEWEST_KEYFRAMES)
        self._clouds: dict[int, Cloud] = {}  # by keyframe id: those that were needed since the newest keyframe

    def use(self, rig: Rig) -> None:
        """Use a corrected rig."""
        self._rig = rig
        self._clouds.clear()

    def add(self, keyframe: Keyframe) -> None:
        """Add the newest keyframe; a new submap discards the earlier ones."""
        if self._keyframes and self._keyframes[-1].submap_id != keyframe.submap_id:
            self._keyframes.clear()
        self._keyframes.append(keyframe)
        self._clouds.clear()

    def find(self, keyframe: Keyframe, expected: F64) -> Iterator[F64]:
        """Hypotheses odom_T_cam (4, 4) of the camera's pose, most likely first, not verified.

        Args:
            keyframe: what the camera sees; its pose is not used.
            expected: (4, 4) odom_T_cam; corners are searched for around their projections from there, in growing
                windows; at last anywhere, for who has turned by more than a window.
        """
        view = place_view_of(keyframe, self._rig, self._config.disparity_sigma_px)
        clouds = [(k, self._around(k)) for k in self._order(expected)[:NEAREST]]
        for share in WINDOWS:
            for centre, cloud in clouds:
                rng = np.random.default_rng([self._config.seed, keyframe.frame_id, centre.kf_id])
                start = se3.inverse(expected) @ centre.odom_T_cam if share < WINDOWS[-1] else np.eye(4)
                b_T_a = self._match(start, view, cloud, share, rng)
                if b_T_a is not None:
                    yield se3.orthonormalize(centre.odom_T_cam @ se3.inverse(b_T_a))

    def _around(self, centre: Keyframe) -> Cloud:
        if centre.kf_id not in self._clouds:
            others = sorted(self._keyframes, key=lambda k: (abs(k.kf_id - centre.kf_id), k.kf_id))[1 : 1 + NEAREST]
            self._clouds[centre.kf_id] = gather(centre, others, self._rig, self._config.disparity_sigma_px)
        return self._clouds[centre.kf_id]

    def _match(self, b_T_a: F64, view: PlaceView, cloud: Cloud, share: float, rng: np.random.Generator) -> F64 | None:
        """b_T_a from corners within a share of the image's width of their projections; None if too few agree."""
        config, rig = self._config, self._rig
        window = share * rig.left.width
        rows_b, rows_a = match_guided(b_T_a, view, cloud, rig, config.max_distance_bits, window)
        corner = view.corner[rows_b]
        matches = pair(view, cloud, rows_b[corner], rows_a[corner])
        sigma_px = 2 * config.sigma_px  # of a corner matched from a distant view
        start = ransac_pose(matches, rig, rng, sigma_px)
        if start is None:
            return None
        pose = refine_pose(start, matches, rig, sigma_px)
        enough = pose.inlier.sum() >= max(MIN_INLIERS, 0.5 * len(matches.points_a))
        return pose.b_T_a if enough else None

    def _order(self, expected: F64) -> list[Keyframe]:
        def difference(keyframe: Keyframe) -> tuple[float, int]:
            metres, radians = se3.extent(se3.inverse(keyframe.odom_T_cam) @ expected)
            return float(metres + 2 * radians), -keyframe.kf_id  # 2 m change the view as much as a radian

        return sorted(self._keyframes, key=difference)
