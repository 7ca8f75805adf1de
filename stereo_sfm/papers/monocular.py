"""Monocular tracking as in the C++ course system: start by essential matrix, then PnP against the last keyframe.

Per frame: match with the last keyframe, pose from its known points by PnP and motion-only bundle adjustment. A frame
becomes a keyframe after more than 19 frames when fewer than 80 points agree; it then takes over points of earlier
keyframes that reproject and match, and new points are triangulated between both keyframes. Bundle adjustment and the
culling of bad points are the mapper's; poses that jump are refused here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.motion_only import bearing_errors, pose_covariance
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.papers.descriptor_tracker import DescriptorTracker
from stereo_sfm.papers.feature_view import FeatureView
from stereo_sfm.papers.local_points import LocalPoints
from stereo_sfm.papers.matching import epipolar_inliers
from stereo_sfm.papers.monocular_start import MIN_MATCHES, MIN_PARALLAX_DEG, good_points, start_from
from stereo_sfm.papers.odometry.pnp import pnp_pose
from stereo_sfm.timing import NoSpans
from stereo_sfm.types import F64, I64, Frame, Keyframe, MapUpdate, StereoImage, TrackState

_FIRST_VIEW_LASTS = 60  # frames that a first view waits for its partner
_MAX_TURN = np.radians(30.0)  # radians: a larger rotation between frames is an error
_REPROJECT_PX = 3.0  # px by which a point may be off its projection: that of a keyframe before bundle adjustment


class MonocularTracker(DescriptorTracker):
    """Unit of length: the median distance of the first points, of every new map again."""

    def __init__(self, config: Config, rig: Rig, spans: NoSpans | None = None) -> None:
        super().__init__(config, Rig(rig.left, left_mask=rig.left_mask), spans)
        self._local = LocalPoints(np.zeros(0, np.int64), np.zeros((0, 3)), self._kind.empty())
        self._first: FeatureView | None = None
        self._first_stamp, self._first_age = 0, 0
        self._force_keyframe = False

    def apply(self, update: MapUpdate) -> None:
        """Take the map's points and go on from where it puts the newest keyframe that both know."""
        self._correct(update)
        self._local.apply(update, self._ids)
        if self._keyframe is not None:
            self._keyframe = self._with_positions(self._keyframe, self._odom_T_kf)

    def _with_positions(self, view: FeatureView, odom_T_cam: F64) -> FeatureView:
        """The view with its points where the local map has them; points that left the map are unknown again."""
        ids = self._ids.current(view.ids)
        points = se3.transform(se3.inverse(odom_T_cam), self._local.positions(ids))
        return replace(view, ids=ids, points=points)

    def step(self, image: StereoImage) -> tuple[Frame, Keyframe | None]:
        """Track one image, by its left camera only."""
        rng = np.random.default_rng((self._config.seed, image.frame_id))
        with self._spans.span("features"):
            view = self._views.make(replace(image, right=None, depth=None), None, rng)
        with self._spans.span("motion"):
            if self._keyframe is None:
                return self._start(image, view, rng)
            return self._track(image, view, rng)

    # -- start -----------------------------------------------------------------------------------------------------

    def _start(self, image: StereoImage, view: FeatureView, rng: np.random.Generator) -> tuple[Frame, Keyframe | None]:
        self._first_age += 1
        if self._first is None or self._first_age > _FIRST_VIEW_LASTS:
            return self._wait(image, view, "first_view", new_first=True)
        rows = self._match(self._first.features, view.features)
        if len(rows) < MIN_MATCHES:
            return self._wait(image, view, "too_few_matches", new_first=True)
        try:
            start = start_from(
                self._first.bearings[rows[:, 0]], view.bearings[rows[:, 1]], self._pixel, self._odometry, rng
            )
        except Degenerate as refusal:
            return self._wait(image, view, refusal.reason, new_first=False)
        found = np.isfinite(start.points[:, 2])
        rows, points = rows[found], start.points[found]
        spread = np.full((len(self._first), 3), np.nan)
        spread[rows[:, 0]] = points
        first = self._ids.give_new(replace(self._first, points=spread), only=np.isfinite(spread[:, 2]))
        keyframe = self._enter(first, self._first_stamp, self._odom_T_cam)
        self._odom_T_cam = self._odom_T_cam @ start.first_T_second
        self._keyframe = self._ids.inherit(view, first, rows)
        self._keyframe = self._with_positions(self._keyframe, self._odom_T_cam)
        self._odom_T_kf = self._odom_T_cam
        self._force_keyframe = True  # the second view of the map follows with the next frame
        state = TrackState.OK if self._submap == 0 else TrackState.RESTARTED
        return self._frame(image, self._keyframe, state, "", True, {"inliers": float(len(rows))}), keyframe

    def _wait(self, image: StereoImage, view: FeatureView, reason: str, new_first: bool) -> tuple[Frame, None]:
        if new_first:
            self._first, self._first_stamp, self._first_age = view, image.stamp_ns, 0
        state = TrackState.INITIALIZING if self._submap == 0 else TrackState.LOST
        return self._frame(image, view, state, reason, False), None

    # -- tracking --------------------------------------------------------------------------------------------------

    def _track(self, image: StereoImage, view: FeatureView, rng: np.random.Generator) -> tuple[Frame, Keyframe | None]:
        assert self._keyframe is not None
        rows = self._match(self._keyframe.features, view.features)
        known = rows[np.isfinite(self._keyframe.points[rows[:, 0], 2])]
        try:
            cam_T_kf, inliers = pnp_pose(
                self._keyframe.points[known[:, 0]], view.bearings[known[:, 1]], self._pixel, self._odometry, rng
            )
            pose = self._odom_T_kf @ se3.inverse(cam_T_kf)
            self._check(pose, self._keyframe.points[known[inliers, 0]])
        except Degenerate as refusal:
            return self._lose(image, view, refusal.reason)
        state = TrackState.RECOVERED if self._lost else TrackState.OK
        self._lost = 0
        self._velocity = se3.inverse(self._odom_T_cam) @ pose
        self._odom_T_cam = se3.orthonormalize(pose)
        self._frames_since_kf += 1
        seen = self._ids.inherit(view, self._keyframe, known[inliers])
        covariance = pose_covariance(se3.transform(cam_T_kf, self._keyframe.points[known[inliers, 0]]), self._pixel)
        agreeing = int(inliers.sum())
        wanted = self._wants_keyframe(agreeing)
        keyframe = None
        if wanted:
            seen = self._new_keyframe_view(seen, rows, rng)
            keyframe = self._enter(seen, image.stamp_ns, self._odom_T_cam)
        return self._frame(image, seen, state, "", wanted, {"inliers": float(agreeing)}, covariance), keyframe

    def _check(self, pose: F64, points: F64) -> None:
        """A bad pose is filtered: no camera moves by half the distance of what it sees, or turns 30 degrees, a frame.

        Raises:
            Degenerate: "implausible_pose".
        """
        step = se3.inverse(self._odom_T_cam) @ pose
        reach = 0.5 * (1 + self._lost) * float(np.median(np.linalg.norm(points, axis=1)))
        turn = float(np.linalg.norm(se3.so3_log(step[:3, :3])))
        if np.linalg.norm(step[:3, 3]) > reach or turn > _MAX_TURN * (1 + self._lost):
            raise Degenerate("implausible_pose", "the pose jumps")

    def _wants_keyframe(self, inliers: int) -> bool:
        o = self._odometry
        if self._force_keyframe or inliers < o.keyframe_rescue_inliers:
            self._force_keyframe = False
            return True
        if self._frames_since_kf <= o.keyframe_min_frames:
            return False
        if o.keyframe_frames and self._frames_since_kf >= o.keyframe_frames:
            return True
        known = int(np.isfinite(self._keyframe.points[:, 2]).sum()) if self._keyframe is not None else 0
        return inliers < (o.keyframe_min_inliers or o.keyframe_ratio * max(known, 1))

    def _new_keyframe_view(self, view: FeatureView, rows: I64, rng: np.random.Generator) -> FeatureView:
        """Known points found again, then new ones from the matches with the last keyframe that have none yet."""
        view = self._find_again(view)
        assert self._keyframe is not None
        fresh = rows[(view.ids[rows[:, 1]] < 0) & ~np.isfinite(self._keyframe.points[rows[:, 0], 2])]
        a, b = self._keyframe.bearings[fresh[:, 0]], view.bearings[fresh[:, 1]]
        fresh = fresh[epipolar_inliers(a, b, 2 * self._odometry.epipolar_px * self._pixel, rng)]
        now_T_kf = se3.inverse(self._odom_T_cam) @ self._odom_T_kf
        # From the new view, so that the points come out in its camera.
        rays = view.bearings[fresh[:, 1]], self._keyframe.bearings[fresh[:, 0]]
        points = good_points(*rays, now_T_kf, _REPROJECT_PX * self._pixel, np.radians(MIN_PARALLAX_DEG))
        positions = se3.transform(se3.inverse(self._odom_T_cam), self._local.positions(view.ids))
        positions[fresh[:, 1]] = points
        view = replace(view, points=positions)
        return self._ids.give_new(view, only=np.isfinite(positions[:, 2]) & (view.ids < 0))

    def _find_again(self, view: FeatureView) -> FeatureView:
        """Ids for points of earlier keyframes that reproject to a feature of the view with a similar descriptor."""
        free = np.flatnonzero(view.ids < 0)
        absent = np.flatnonzero(~np.isin(self._local.ids, view.ids))
        cam_T_odom = se3.inverse(self._odom_T_cam)
        ahead = se3.transform(cam_T_odom, self._local.points[absent])
        absent = absent[(ahead[:, 2] / np.linalg.norm(ahead, axis=1).clip(1e-9)) > 0.3]
        if len(absent) == 0 or len(free) < 2:
            return view
        pairs = self._match(self._local.features(absent), view.features.rows(view.ids < 0))
        local, row = absent[pairs[:, 0]], free[pairs[:, 1]]
        near = bearing_errors(cam_T_odom, self._local.points[local], view.bearings[row]) < _REPROJECT_PX * self._pixel
        ids, ages = view.ids.copy(), view.ages.copy()
        ids[row[near]] = self._local.ids[local[near]]
        ages[row[near]] = 1
        return replace(view, ids=ids, ages=ages)

    def _lose(self, image: StereoImage, view: FeatureView, reason: str) -> tuple[Frame, None]:
        """Stay where the motion was going and look for the keyframe again; after a while begin a new map."""
        seconds = self._count_lost(image.stamp_ns)
        if self._lost <= 3:
            self._odom_T_cam = self._odom_T_cam @ self._velocity
        if seconds > self._config.tracker.lost_s:
            self._submap += 1
            self._lost = 0
            self._keyframe = None
            self._first, self._first_stamp, self._first_age = view, image.stamp_ns, 0
            self._local = LocalPoints(np.zeros(0, np.int64), np.zeros((0, 3)), self._kind.empty())
        return self._frame(image, view, TrackState.LOST, reason, False), None

    def _enter(self, view: FeatureView, stamp_ns: int, odom_T_cam: F64) -> Keyframe:
        """Its points are matched with later keyframes, too."""
        self._local.add(view, odom_T_cam)
        return super()._enter(view, stamp_ns, odom_T_cam)
