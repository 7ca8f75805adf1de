"""Tracking by descriptors, frame by frame, around any motion estimator: the papers' front end (retail paper, IV-A).

Features of the current frame are matched with those of the reference (the last good frame, or the last keyframe), an
estimator of `odometry/` turns the matches into a motion, and motions accumulate to the odometry pose (equation 19).
Points keep their ids through matches, so the mapper, the loop closer and the evaluation are those of the default.
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
from stereo_sfm.papers.extraction import circle_mask
from stereo_sfm.papers.feature_view import FeatureView
from stereo_sfm.papers.matching import epipolar_inliers
from stereo_sfm.papers.motion_estimator import FramePair, Motion, StepScale, estimator
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.flow.map_points import rows_of
from stereo_sfm.tracking.flow.place_corners import PlaceCorners
from stereo_sfm.types import F64, I64, U8, Frame, Keyframe, MapUpdate, StereoImage, TrackState, Trajectory


class FeatureTracker(DescriptorTracker):
    """Motions from frame to frame."""

    def __init__(
        self, config: Config, rig: Rig, spans: NoSpans | None = None, ground_truth: Trajectory | None = None
    ) -> None:
        super().__init__(config, rig, spans)
        self._place_corners = PlaceCorners.from_config(config, rig)
        self._estimator = estimator(config.odometry.method).make(config.odometry, rig.left)
        self._scale = StepScale(config.odometry, ground_truth)
        self._last: FeatureView | None = None
        self._odom_T_last = np.eye(4)
        self._last_stamp = self._kf_stamp = 0

    def apply(self, update: MapUpdate) -> None:
        """Take over fused ids and, for motions from a keyframe, the map's positions of its points."""
        moved = self._correct(update)
        if moved is not None:
            self._odom_T_last = moved @ self._odom_T_last
        if self._last is not None:
            self._last = replace(self._last, ids=self._ids.current(self._last.ids))
        if self._keyframe is None:
            return
        ids = self._ids.current(self._keyframe.ids)
        self._keyframe = replace(self._keyframe, ids=ids)
        own = np.flatnonzero(update.kf_ids == self._kf_id)
        if self._odometry.reference == "keyframe" and len(own):
            kf_T_map = se3.inverse(update.map_T_kf[own[0]])
            self._keyframe = replace(self._keyframe, points=_moved(self._keyframe.points, ids, update, kf_T_map))

    def step(self, image: StereoImage) -> tuple[Frame, Keyframe | None]:
        """Track one image."""
        rng = np.random.default_rng((self._config.seed, image.frame_id))
        with self._spans.span("features"):
            view = self._views.make(image, self._mask(image), rng)
        if self._last is None:
            return self._begin(image, view)
        with self._spans.span("motion"):
            outcome = self._move(image, view, rng)
        if isinstance(outcome, Degenerate):
            return self._lose(image, view, outcome.reason)
        motion, view = outcome
        state = TrackState.RECOVERED if self._lost else TrackState.OK
        last_T_now = se3.inverse(self._odom_T_last) @ self._odom_T_cam
        self._velocity = se3.exp(se3.log(last_T_now) / (1 + self._lost))
        self._lost = 0
        return self._finish(image, view, motion, state)

    def _mask(self, image: StereoImage) -> U8 | None:
        radius = self._config.features.mask_radius_px
        if radius <= 0 or self._keyframe is None or len(self._keyframe) == 0:
            return None
        return circle_mask(image.left.shape, self._keyframe.features.uv, radius)

    def _begin(self, image: StereoImage, view: FeatureView) -> tuple[Frame, Keyframe | None]:
        if len(view) < self._odometry.min_inliers:
            return self._frame(image, view, TrackState.INITIALIZING, "too_few_points", False), None
        return self._begin_here(image, view, TrackState.OK, "")

    def _begin_here(
        self, image: StereoImage, view: FeatureView, state: TrackState, reason: str
    ) -> tuple[Frame, Keyframe | None]:
        view = self._ids.give_new(view)
        keyframe = self._make_keyframe(image, view)
        self._remember(image, view)
        return self._frame(image, view, state, reason, True), keyframe

    def _move(
        self, image: StereoImage, view: FeatureView, rng: np.random.Generator
    ) -> tuple[Motion, FeatureView] | Degenerate:
        """Motion from the reference, with the view's ids filled in, or why there is none."""
        assert self._last is not None and self._keyframe is not None
        reference, odom_T_reference, since = self._last, self._odom_T_last, self._last_stamp
        if self._odometry.reference == "keyframe":
            reference, odom_T_reference, since = self._keyframe, self._odom_T_kf, self._kf_stamp
        rows = self._match(reference.features, view.features)
        if self._config.features.motion_check:
            rays = reference.bearings[rows[:, 0]], view.bearings[rows[:, 1]]
            rows = rows[epipolar_inliers(*rays, 2 * self._config.features.epipolar_px * self._pixel, rng)]
        try:
            motion = self._estimator(_pair(reference, view, rows, self._pixel), rng)
            motion = self._scale.metric(motion, since, image.stamp_ns)
        except Degenerate as refusal:
            return refusal
        reference_T_now = se3.inverse(se3.from_rotation_translation(motion.rotation, motion.translation))
        self._odom_T_cam = se3.orthonormalize(odom_T_reference @ reference_T_now)
        agreed = rows[motion.inliers]
        view = self._ids.inherit(view, reference, agreed)
        if reference is not self._keyframe:
            now_T_kf = se3.inverse(self._odom_T_cam) @ self._odom_T_kf
            view = self._recover(self._keyframe, view, now_T_kf)
        return motion, self._ids.give_new(view)

    def _recover(self, keyframe: FeatureView, view: FeatureView, now_T_kf: F64) -> FeatureView:
        """Ids for points of the last keyframe that were missed in between: descriptor and position, to 4 px, agree.

        Args:
            now_T_kf: (4, 4) by the motion just estimated.
        """
        free_kf = ~np.isin(self._ids.current(keyframe.ids), view.ids) & np.isfinite(keyframe.points[:, 2])
        free_now = view.ids < 0
        rows = self._match(keyframe.features.rows(free_kf), view.features.rows(free_now))
        rows = np.stack([np.flatnonzero(free_kf)[rows[:, 0]], np.flatnonzero(free_now)[rows[:, 1]]], axis=1)
        if len(rows) == 0:
            return view
        errors = bearing_errors(now_T_kf, keyframe.points[rows[:, 0]], view.bearings[rows[:, 1]])
        return self._ids.inherit(view, keyframe, rows[errors < 4.0 * self._pixel])

    def _lose(self, image: StereoImage, view: FeatureView, reason: str) -> tuple[Frame, Keyframe | None]:
        """No motion: continue with the last velocity; after some time without start a new submap there."""
        seconds = self._count_lost(image.stamp_ns)
        self._odom_T_cam = self._odom_T_cam @ self._velocity
        if seconds <= self._config.tracker.lost_s or len(view) < self._odometry.min_inliers:
            return self._frame(image, view, TrackState.LOST, reason, False), None
        self._lost = 0
        self._submap += 1
        self._velocity = np.eye(4)
        return self._begin_here(image, view, TrackState.RESTARTED, reason)

    def _finish(
        self, image: StereoImage, view: FeatureView, motion: Motion, state: TrackState
    ) -> tuple[Frame, Keyframe | None]:
        self._frames_since_kf += 1
        chosen = np.isfinite(view.points[:, 2]) & (view.ages > 0)
        covariance = pose_covariance(view.points[chosen], self._pixel)
        inliers = int(motion.inliers.sum())
        wanted = self._wants_keyframe(view, inliers)
        stats = {"inliers": float(inliers), "matches": float(len(motion.inliers)), **motion.stats}
        frame = self._frame(image, view, state, "", wanted, stats, covariance)
        keyframe = self._make_keyframe(image, view) if wanted else None
        self._remember(image, view)
        return (replace(frame, reference_kf_id=self._kf_id, kf_T_cam=np.eye(4)) if wanted else frame), keyframe

    def _wants_keyframe(self, view: FeatureView, inliers: int) -> bool:
        """Fewer than 30 % of the keyframe's points tracked, or 30 frames since (retail paper, IV-A4)."""
        assert self._keyframe is not None
        o = self._odometry
        if self._frames_since_kf <= o.keyframe_min_frames:
            return False
        if o.keyframe_frames and self._frames_since_kf >= o.keyframe_frames:
            return True
        if o.keyframe_min_inliers and inliers < o.keyframe_min_inliers:
            return True
        tracked = np.isin(self._ids.current(self._keyframe.ids), view.ids).mean()
        return bool(tracked < o.keyframe_ratio)

    def _make_keyframe(self, image: StereoImage, view: FeatureView) -> Keyframe:
        keyframe = self._enter(view, image.stamp_ns, self._odom_T_cam)
        self._kf_stamp = image.stamp_ns
        if self._place_corners is None:
            return keyframe
        return replace(keyframe, corners=self._place_corners.find(image))

    def _remember(self, image: StereoImage, view: FeatureView) -> None:
        self._last, self._odom_T_last, self._last_stamp = view, self._odom_T_cam, image.stamp_ns


def _pair(last: FeatureView, now: FeatureView, rows: I64, pixel_rad: float) -> FramePair:
    """Matched rows (M, 2) as input of the estimators."""
    a, b = rows.T
    return FramePair(
        last.bearings[a], now.bearings[b], last.points[a], now.points[b], last.sigmas[a], now.sigmas[b], pixel_rad,
        last.image, now.image, last.frame_id, now.frame_id,
    )  # fmt: skip


def _moved(points: F64, ids: I64, update: MapUpdate, kf_T_map: F64) -> F64:
    """(N, 3) points of a keyframe with the map's positions where the update has them."""
    out, (hit, rows) = points.copy(), rows_of(update.point_ids, ids)
    out[hit] = se3.transform(kf_T_map, update.points_map[rows])
    return out
