"""Messages of the descriptor trackers."""

from __future__ import annotations

from stereo_sfm.papers.feature_view import FeatureView
from stereo_sfm.tracking.descriptors import describe
from stereo_sfm.types import F64, Keyframe, Observations


def observations_of(view: FeatureView) -> Observations:
    """Rows with an id; those that were seen before are the inliers of the pose."""
    rows = view.ids >= 0
    return Observations(
        view.ids[rows], view.features.uv[rows], view.uv_right[rows], view.ages[rows], view.ages[rows] > 0
    )


def keyframe_of(view: FeatureView, stamp_ns: int, kf_id: int, odom_T_cam: F64, submap_id: int) -> Keyframe:
    """A keyframe with binary descriptors, whatever the tracker matches by, and no corners to recognise it by."""
    rows = view.ids >= 0
    uv = view.features.uv[rows]
    return Keyframe(
        kf_id=kf_id,
        frame_id=view.frame_id,
        stamp_ns=stamp_ns,
        odom_T_cam=odom_T_cam.copy(),
        point_ids=view.ids[rows],
        uv_left=uv,
        uv_right=view.uv_right[rows],
        points_cam=view.points[rows],
        descriptors=describe(view.image, uv),
        submap_id=submap_id,
    )
