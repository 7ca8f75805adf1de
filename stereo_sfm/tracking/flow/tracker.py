"""The default tracker: flow of grid-spread points, stereo by bearings, motion-only optimisation over both images.

Per frame: predict the pose (constant velocity), predict every point's pixel, follow it by translation, align it with
its first appearance, find it in the right image, solve the pose robustly, refine the points' distances. At keyframes:
new corners where points are missing, stereo matches for them, descriptors for the mapper; corners of the whole image
for the loop closer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.descriptors import describe
from stereo_sfm.tracking.flow import klt, pose_solver
from stereo_sfm.tracking.flow.coarse_rotation import CoarseRotation
from stereo_sfm.tracking.flow.corners import corner_mask, detect_corners
from stereo_sfm.tracking.flow.place_corners import PlaceCorners
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo import StereoMatcher
from stereo_sfm.tracking.flow.stereo_cameras import Eyes
from stereo_sfm.tracking.flow.tracks import Patches, Tracks
from stereo_sfm.types import (
    F32,
    F64,
    I64,
    Bool,
    Corners,
    Frame,
    Keyframe,
    MapUpdate,
    Observations,
    StereoImage,
    TrackState,
)

CAUCHY_SCALES = np.array([20.0, 10.0, 6.0, 4.0, 3.0, 2.0, 2.0])  # in sigmas, one Gauss-Newton step each


@dataclass(frozen=True)
class Motion:
    """How the camera is expected to have moved since the last frame."""

    pose: F64  # (4, 4) odom_T_cam
    moved: F64  # (6,) tangent from the last frame's pose to this one
    seconds: float  # since the last frame

    @property
    def velocity(self) -> F64:
        """(6,) tangent a second."""
        return self.moved / self.seconds if self.seconds > 0 else np.zeros(6)


@dataclass
class PoseSolution:
    """What motion-only optimisation found."""

    pose: F64  # (4, 4) odom_T_cam
    velocity: F64  # (6,) tangent a second while the rows were read; as expected for a global shutter
    covariance: F64  # (6, 6)
    error: F64  # (N,) whitened
    sigma_px: float  # what it is whitened by
    max_error: float
    reason: str = ""  # why there is no pose

    @property
    def inlier(self) -> Bool:
        """(N,)"""
        return self.error < self.max_error

    @property
    def inliers(self) -> int:
        """How many points agree with the pose."""
        return int(self.inlier.sum())

    @property
    def residual_px(self) -> float:
        """Median over the points; NaN without a pose."""
        return math.nan if self.reason else self.sigma_px * float(np.median(self.error[np.isfinite(self.error)]))

    def good(self, config: TrackerConfig, before: int) -> bool:
        """Whether most of the points that were followed agree."""
        return not self.reason and self.inliers > max(2 * config.min_features, 0.4 * before)


class Tracker:
    """One `step` per image. Frame poses are odom_T_cam; the odometry frame is the first camera."""

    def __init__(
        self, config: TrackerConfig, rig: Rig, spans: NoSpans | None = None, place_corners: PlaceCorners | None = None
    ) -> None:
        """`place_corners`: what keyframes are recognised by; None: by nothing."""
        self._config = config
        self._rig = rig
        self._eyes = Eyes.of(rig)
        self._spans = spans or NoSpans()
        self._stereo = StereoMatcher(config, rig)
        self._shutter = RollingShutter(rig)
        self._mask = corner_mask(rig.left, config.max_angle_deg)
        self._place_corners = place_corners
        area = 4.0 * self._mask.sum()
        self._spacing = 0.75 * math.sqrt(area / config.max_features)
        self._patches = Patches(2 * config.max_features)
        self._tracks = Tracks()
        self._pyramid: klt.Pyramid | None = None
        self._pose: F64 = np.eye(4)
        self._velocity: F64 = np.zeros(6)  # tangent per second
        self._stamp_ns = 0
        self._state = TrackState.INITIALIZING
        self._lost = 0
        self._next_point_id = 0
        self._next_kf_id = 0
        self._submap_id = 0
        self._kf_pose: F64 = np.eye(4)
        self._kf_points: int = 0
        self._frames_since_kf = 0
        self._first_level = config.pyramid_levels - 1
        self._miss_px = math.inf  # median distance of points from where they were predicted
        self._noise = 1.0  # observed noise over config.sigma_px
        self._coarse_rotation = CoarseRotation(rig.left, config.pyramid_levels)
        self._map_version = 0
        self._odom_T_map: F64 = np.eye(4)
        self.solution: PoseSolution | None = None  # of the last image; None where points were only begun

    def apply(self, update: MapUpdate) -> None:
        """Take the mapper's better positions of points and of the reference keyframe."""
        self._map_version = update.version
        self._odom_T_map = se3.inverse(update.map_T_odom)
        ids, rows = np.unique(update.fused_point_ids[:, 0], return_index=True)
        if len(ids):
            at = np.clip(np.searchsorted(ids, self._tracks.point_ids), 0, len(ids) - 1)
            hit = ids[at] == self._tracks.point_ids
            self._tracks.point_ids[hit] = update.fused_point_ids[rows[at[hit]], 1]
            _, first = np.unique(self._tracks.point_ids, return_index=True)
            self._tracks = self._tracks.keep(np.isin(np.arange(len(self._tracks)), first))
        if len(update.culled_point_ids):
            self._tracks = self._tracks.keep(~np.isin(self._tracks.point_ids, update.culled_point_ids))
        order = np.argsort(update.point_ids, kind="stable")
        ids = update.point_ids[order]
        if len(ids) and len(self._tracks):
            at = np.clip(np.searchsorted(ids, self._tracks.point_ids), 0, len(ids) - 1)
            hit = ids[at] == self._tracks.point_ids
            self._move_points(hit, se3.transform(self._odom_T_map, update.points_map[order[at[hit]]]))

    def _move_points(self, rows: Bool, points: F64) -> None:
        tracks = self._tracks
        ray = points - tracks.origin[rows]
        distance = np.maximum(np.linalg.norm(ray, axis=1), 1e-6)
        tracks.direction[rows] = ray / distance[:, None]
        tracks.rho[rows] = 1.0 / distance
        tracks.mapped[rows] = True

    def step(self, image: StereoImage) -> tuple[Frame, Keyframe | None]:
        """The pose of one image, and a keyframe when this frame becomes one."""
        with self._spans.span("pyramid"):
            pyramid = klt.build_pyramid(image.left, self._config.pyramid_levels)
            right = self._stereo.prepare(image)
        stats: dict[str, float] = {}
        self.solution = None
        if self._state == TrackState.INITIALIZING:
            return self._initialize(image, pyramid, right, stats)
        dt = (image.stamp_ns - self._stamp_ns) * 1e-9
        moved = self._velocity * dt
        predicted = self._pose @ se3.exp(moved)
        expected = Motion(predicted, moved, dt)
        tracks, uv_right, solution = self._track(pyramid, right, expected)
        if not solution.good(self._config, len(self._tracks)):
            again = self._track(pyramid, right, self._turn(pyramid, expected))
            if again[2].inliers > solution.inliers:
                tracks, uv_right, solution = again
        self.solution = solution
        if solution.reason:
            return self._lose(image, predicted, solution.reason, stats)
        pose, covariance, error, inlier = solution.pose, solution.covariance, solution.error, solution.inlier
        self._noise *= float(0.9 + 0.1 * np.median(error[inlier]) / 0.8)  # 0.8: median of unit noise in four rows
        self._noise = min(max(self._noise, 0.3), 4.0)
        tracks.uv_right = uv_right
        tracks.misses = np.where(inlier, 0, tracks.misses + 1).astype(np.int32)
        tracks.age = tracks.age + np.int32(1)
        self._refine(tracks, solution)
        stats.update(
            tracked=float(len(tracks)),
            inliers=float(inlier.sum()),
            right=float(np.isfinite(uv_right[:, 0]).sum()),
            error=float(np.median(error[inlier])) if inlier.any() else 0.0,
        )
        state = TrackState.OK if self._lost == 0 else TrackState.RECOVERED
        if dt > 0:
            mean = self._moved_to(pose) / dt
            self._shutter.learn(mean, dt)
            self._velocity = solution.velocity if self._shutter.active else mean
        self._accept(image, pyramid, pose, tracks.keep(tracks.misses < 3))
        frame_inlier = inlier[tracks.misses < 3]
        self._frames_since_kf += 1
        keyframe = None
        if self._wants_keyframe():
            with self._spans.span("keyframe"):
                self._add_points(pyramid, right)
                keyframe = self._make_keyframe(image, pyramid, right)
                frame_inlier = np.concatenate([frame_inlier, np.ones(len(self._tracks) - len(frame_inlier), bool)])
        return self._frame(image, covariance, state, "", frame_inlier, keyframe, stats), keyframe

    # -- stages ----------------------------------------------------------------------------------------------------

    def _initialize(
        self, image: StereoImage, pyramid: klt.Pyramid, right: klt.Pyramid | F32, stats: dict[str, float]
    ) -> tuple[Frame, Keyframe | None]:
        """First frame, or the first after a restart: points from stereo alone."""
        self._tracks = Tracks()
        self._accept(image, pyramid, self._pose, self._tracks)
        self._add_points(pyramid, right)
        if len(self._tracks) < 2 * self._config.min_features:
            self._tracks = Tracks()
            self._state = TrackState.INITIALIZING
            reason = "dark" if image.left.max() < 30 else "too_few_points"
            state = TrackState.INITIALIZING if self._submap_id == 0 and self._next_kf_id == 0 else TrackState.LOST
            return self._frame(image, np.eye(6), state, reason, np.zeros(0, bool), None, stats), None
        keyframe = self._make_keyframe(image, pyramid, right)
        state = TrackState.OK if self._submap_id == 0 else TrackState.RESTARTED
        inlier = np.ones(len(self._tracks), bool)
        stats.update(tracked=float(len(inlier)), inliers=float(len(inlier)), right=float(len(inlier)), error=0.0)
        return self._frame(image, np.eye(6) * 1e-12, state, "", inlier, keyframe, stats), keyframe

    def _track(
        self, pyramid: klt.Pyramid, right: klt.Pyramid | F32, expected: Motion
    ) -> tuple[Tracks, F64, PoseSolution]:
        """Follow all points from where they are expected and solve for the pose."""
        with self._spans.span("flow"):
            tracks = self._follow(pyramid, expected)
        with self._spans.span("stereo"):
            uv_right = self._stereo.follow(pyramid, right, tracks.uv, tracks.points(), expected.pose)
        with self._spans.span("pose"):
            return tracks, uv_right, self._solve(tracks, uv_right, expected)

    def _turn(self, pyramid: klt.Pyramid, expected: Motion) -> Motion:
        """The expected motion with the rotation that aligns the whole images."""
        assert self._pyramid is not None
        cur_R_prev = expected.pose[:3, :3].T @ self._pose[:3, :3]
        cur_R_prev = self._coarse_rotation.align(self._pyramid, pyramid, cur_R_prev)
        self._first_level = self._config.pyramid_levels - 1
        turned = se3.from_rotation_translation(self._pose[:3, :3] @ cur_R_prev.T, expected.pose[:3, 3])
        return Motion(turned, self._moved_to(turned), expected.seconds)

    def _moved_to(self, pose: F64) -> F64:
        """(6,) tangent from the last pose to this one."""
        return se3.log(se3.inverse(self._pose) @ pose)

    def _follow(self, pyramid: klt.Pyramid, expected: Motion) -> Tracks:
        """Tracks that are found in the new left image, moved there."""
        config, tracks = self._config, self._tracks
        assert self._pyramid is not None
        guess = self._shutter.project(expected.pose, expected.velocity, tracks.points(), tracks.uv)
        guess = np.where(np.isfinite(guess), guess, tracks.uv)
        uv = guess.copy()
        status, _ = klt.track_translation(
            self._pyramid, pyramid, tracks.uv, uv, self._first_level, 0, 10, config.min_contrast, config.min_ncc,
            klt.WEIGHTS,
        )  # fmt: skip
        found = status == klt.TRACKED
        self._miss_px = float(np.median(np.linalg.norm(uv - guess, axis=1)[found])) if found.any() else np.inf
        warp = tracks.warp.copy()
        ncc = klt.track_affine(
            pyramid[0], uv, warp, tracks.slot, found, self._patches.patch, self._patches.gradients,
            self._patches.inverse_normal, self._patches.contrast, 6, klt.WEIGHTS, klt.COORDINATES,
        )  # fmt: skip
        found &= (ncc > config.min_anchor_ncc) & self._rig.left.inside(uv, 1.0)
        out = tracks.keep(found)
        out.uv, out.warp = uv[found], warp[found]
        return out

    def _solve(self, tracks: Tracks, uv_right: F64, expected: Motion) -> PoseSolution:
        """Pose from where it is expected; from the previous pose when that finds no consensus."""
        config = self._config
        if len(tracks) < config.min_features:
            far = np.full(len(tracks), np.inf)
            return PoseSolution(np.eye(4), np.zeros(6), np.eye(6), far, 0.0, 0.0, "too_few_points")
        best = self._optimise(tracks, uv_right, expected)
        if best.inliers < 0.5 * len(tracks):
            still = Motion(self._pose, np.zeros(6), expected.seconds)
            best = max(best, self._optimise(tracks, uv_right, still), key=lambda s: s.inliers)
        if best.inliers < config.min_features:
            best.reason = "no_consensus"
        return best

    def _optimise(self, tracks: Tracks, uv_right: F64, expected: Motion) -> PoseSolution:
        sigma_px = self._config.sigma_px * self._noise
        pose, velocity, covariance, error = pose_solver.optimise_pose(
            expected.pose, expected.moved, expected.seconds, self._shutter.velocity_sigma(),
            self._shutter.row_seconds(tracks.uv), tracks.origin, tracks.direction, tracks.rho, tracks.variance,
            tracks.uv, uv_right, self._eyes.cams, self._eyes.right_T_left, sigma_px, CAUCHY_SCALES,
        )  # fmt: skip
        return PoseSolution(pose, velocity, covariance, error, sigma_px, self._config.max_error)

    def _refine(self, tracks: Tracks, solution: PoseSolution) -> None:
        pose_solver.refine_depth(
            solution.pose, solution.velocity, self._shutter.row_seconds(tracks.uv), tracks.origin, tracks.direction,
            tracks.rho, tracks.variance, tracks.uv, tracks.uv_right, solution.inlier & ~tracks.mapped, self._eyes.cams,
            self._eyes.right_T_left, self._config.depth_sigma_px, 1e-3,
        )  # fmt: skip

    def _accept(self, image: StereoImage, pyramid: klt.Pyramid, pose: F64, tracks: Tracks) -> None:
        self._pose, self._stamp_ns, self._pyramid, self._tracks = pose, image.stamp_ns, pyramid, tracks
        self._lost = 0
        self._state = TrackState.OK
        self._first_level = 1 if self._miss_px < 3.0 else self._config.pyramid_levels - 1
        self._patches.keep_only(tracks.slot)

    def _lose(
        self, image: StereoImage, predicted: F64, reason: str, stats: dict[str, float]
    ) -> tuple[Frame, Keyframe | None]:
        """Keep the last good frame's tracks and predict; after a while begin a new submap."""
        self._lost += 1
        self._first_level = self._config.pyramid_levels - 1
        if image.left.max() < 30:
            reason = "dark"
        if self._lost > self._config.lost_frames:
            self._pose = predicted
            self._submap_id += 1
            self._velocity = np.zeros(6)
            self._state = TrackState.INITIALIZING
        frame_pose, self_pose = predicted, self._pose
        self._pose = frame_pose
        frame = self._frame(image, np.eye(6), TrackState.LOST, reason, np.zeros(0, bool), None, stats)
        self._pose = self_pose
        return frame, None

    def _wants_keyframe(self) -> bool:
        config = self._config
        left = len(self._tracks)  # new points come with keyframes only
        return self._frames_since_kf >= config.keyframe_max_frames or left < config.keyframe_share * self._kf_points

    def _make_keyframe(self, image: StereoImage, pyramid: klt.Pyramid, right: klt.Pyramid | F32) -> Keyframe:
        tracks = self._tracks
        points_cam = se3.transform(se3.inverse(self._pose), tracks.points())
        corners = Corners.none() if self._place_corners is None else self._place_corners.find_in(pyramid, right)
        uv_left, uv_right = self._shutter.at_stamp(tracks.uv, tracks.uv_right, points_cam, self._velocity)
        keyframe = Keyframe(
            kf_id=self._next_kf_id,
            frame_id=image.frame_id,
            stamp_ns=image.stamp_ns,
            odom_T_cam=self._pose.copy(),
            point_ids=tracks.point_ids.copy(),
            uv_left=uv_left.copy(),
            uv_right=uv_right.copy(),
            points_cam=points_cam,
            descriptors=describe(pyramid[0], tracks.uv),
            submap_id=self._submap_id,
            corners=self._shutter.corners_at_stamp(corners, self._velocity),
        )
        self._next_kf_id += 1
        self._kf_pose = self._pose.copy()
        self._kf_points = len(tracks)
        self._frames_since_kf = 0
        return keyframe

    def _add_points(self, pyramid: klt.Pyramid, right: klt.Pyramid | F32) -> None:
        config = self._config
        missing = config.max_features - len(self._tracks)
        if missing <= 0:
            return
        corners = detect_corners(pyramid[1], self._mask, self._tracks.uv, missing, self._spacing, config.corner_quality)
        match = self._stereo.match(pyramid, right, corners)
        good = match.good
        slots = self._patches.take(int(good.sum()))
        good[np.flatnonzero(good)[len(slots) :]] = False
        uv = match.uv_left[good]
        textured = self._patches_make(pyramid, uv, slots)
        n = int(textured.sum())
        origin, direction = self._shutter.rays(self._pose, self._velocity, uv[textured], match.bearing[good][textured])
        new = Tracks(
            point_ids=self._next_point_id + np.arange(n, dtype=np.int64),
            uv=uv[textured],
            uv_right=match.uv_right[good][textured],
            origin=origin,
            direction=direction,
            rho=np.maximum(match.rho[good][textured], 1e-4),
            variance=match.variance[good][textured],
            age=np.zeros(n, np.int32),
            misses=np.zeros(n, np.int32),
            warp=np.tile(np.eye(2), (n, 1, 1)),
            slot=slots[textured],
            mapped=np.zeros(n, bool),
        )
        self._next_point_id += n
        self._tracks = self._tracks.append(new)
        self._patches.keep_only(self._tracks.slot)

    def _patches_make(self, pyramid: klt.Pyramid, uv: F64, slots: I64) -> Bool:
        store = self._patches
        return klt.make_patches(
            pyramid, uv, slots, klt.WEIGHTS, klt.COORDINATES, store.patch, store.gradients, store.inverse_normal,
            store.contrast,
        )  # fmt: skip

    def _frame(
        self,
        image: StereoImage,
        covariance: F64,
        state: TrackState,
        reason: str,
        inlier: Bool,
        keyframe: Keyframe | None,
        stats: dict[str, float],
    ) -> Frame:
        tracks = self._tracks if len(inlier) == len(self._tracks) else Tracks()
        return Frame(
            frame_id=image.frame_id,
            stamp_ns=image.stamp_ns,
            odom_T_cam=self._pose.copy(),
            covariance=covariance,
            state=state,
            reason=reason,
            observations=Observations(
                tracks.point_ids.copy(), tracks.uv.copy(), tracks.uv_right.copy(), tracks.age.copy(), inlier
            ),
            reference_kf_id=self._next_kf_id - 1,
            kf_T_cam=se3.inverse(self._kf_pose) @ self._pose,
            map_version=self._map_version,
            is_keyframe=keyframe is not None,
            stats=stats,
        )
