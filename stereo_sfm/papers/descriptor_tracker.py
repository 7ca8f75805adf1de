"""What the descriptor trackers share: where the camera and the keyframes are, and their messages."""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.geometry import se3
from stereo_sfm.papers.extraction import Features, feature_kind
from stereo_sfm.papers.feature_view import FeatureView, ViewMaker
from stereo_sfm.papers.matching import match_features
from stereo_sfm.papers.point_ids import PointIds
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.descriptors import describe
from stereo_sfm.types import F64, I64, Frame, Keyframe, MapUpdate, Observations, StereoImage, TrackState


class DescriptorTracker:
    """One per run; `step` every image in order, `apply` every map update when the schedule says so."""

    def __init__(self, config: Config, rig: Rig, spans: NoSpans | None) -> None:
        """`rig`: the cameras whose images it uses."""
        self._config, self._odometry, self._spans = config, config.odometry, spans or NoSpans()
        self._kind = feature_kind(config.features.kind)
        self._views = ViewMaker(config.features, rig)
        self._pixel = rig.pixel_angle
        self._ids = PointIds()
        self._odom_T_cam = np.eye(4)
        self._velocity = np.eye(4)  # last_T_now of the last good step
        self._keyframe: FeatureView | None = None
        self._kf_id = -1
        self._odom_T_kf = np.eye(4)
        self._odom_T_kfs: dict[int, F64] = {}  # of keyframes whose update is to come
        self._frames_since_kf = 0
        self._lost = 0  # frames without a pose
        self._lost_ns = 0  # the first of these frames
        self._submap = 0
        self._map_version = 0

    def describe(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe of the last step, which has its descriptors."""
        return keyframe

    def _correct(self, update: MapUpdate) -> F64 | None:
        """Take over fused ids, and go on from where the map puts the newest keyframe that both know.

        Returns:
            (4, 4) by which poses in the odometry frame were moved; None where the update knows no keyframe.
        """
        self._map_version = update.version
        self._ids.fuse(update.fused_point_ids)
        known = np.flatnonzero(np.isin(update.kf_ids, list(self._odom_T_kfs)))
        if not len(known):
            return None
        row = known[np.argmax(update.kf_ids[known])]
        newest = int(update.kf_ids[row])
        moved = se3.inverse(update.map_T_odom) @ update.map_T_kf[row] @ se3.inverse(self._odom_T_kfs[newest])
        self._odom_T_kfs = {k: moved @ pose for k, pose in self._odom_T_kfs.items() if k >= newest}
        self._odom_T_cam, self._odom_T_kf = moved @ self._odom_T_cam, moved @ self._odom_T_kf
        return moved

    def _match(self, first: Features, second: Features) -> I64:
        """(M, 2) rows of matching features, see `match_features`."""
        return match_features(first, second, self._kind.norm, self._config.features.ratio)

    def _count_lost(self, stamp_ns: int) -> float:
        """One more frame without a pose. Returns the seconds since the first of them."""
        self._lost_ns = self._lost_ns if self._lost else stamp_ns
        self._lost += 1
        return (stamp_ns - self._lost_ns) * 1e-9

    def _enter(self, view: FeatureView, stamp_ns: int, odom_T_cam: F64) -> Keyframe:
        """Make a view the newest keyframe: with binary descriptors, whatever the tracker matches by, and no corners."""
        self._kf_id += 1
        self._keyframe, self._odom_T_kf = view, odom_T_cam
        self._odom_T_kfs[self._kf_id] = odom_T_cam
        self._frames_since_kf = 0
        rows = view.ids >= 0
        uv = view.features.uv[rows]
        return Keyframe(
            kf_id=self._kf_id,
            frame_id=view.frame_id,
            stamp_ns=stamp_ns,
            odom_T_cam=odom_T_cam.copy(),
            point_ids=view.ids[rows],
            uv_left=uv,
            uv_right=view.uv_right[rows],
            points_cam=view.points[rows],
            descriptors=describe(view.image, uv),
            submap_id=self._submap,
        )

    def _frame(
        self,
        image: StereoImage,
        view: FeatureView,
        state: TrackState,
        reason: str,
        is_keyframe: bool,
        stats: dict[str, float] | None = None,
        covariance: F64 | None = None,
    ) -> Frame:
        rows = view.ids >= 0  # those that were seen before are the inliers of the pose
        return Frame(
            frame_id=image.frame_id,
            stamp_ns=image.stamp_ns,
            odom_T_cam=self._odom_T_cam.copy(),
            covariance=np.eye(6) if covariance is None else covariance,
            state=state,
            reason=reason,
            observations=Observations(
                view.ids[rows], view.features.uv[rows], view.uv_right[rows], view.ages[rows], view.ages[rows] > 0
            ),
            reference_kf_id=self._kf_id,
            kf_T_cam=se3.inverse(self._odom_T_kfs.get(self._kf_id, np.eye(4))) @ self._odom_T_cam,
            map_version=self._map_version,
            is_keyframe=is_keyframe,
            stats={"features": float(len(view)), **(stats or {"inliers": 0.0})},
        )
