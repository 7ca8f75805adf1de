"""The default tracker: flow of grid-spread points, stereo by bearings, motion-only optimisation over both images.

Per frame: predict the pose (constant velocity), predict every point's pixel, follow it by translation, align it with
its first appearance, match it in the right image, solve for the pose robustly, refine the points' distances. At
keyframes: new corners where points are missing, stereo matches for them, descriptors for the mapper; corners of the
whole image for the loop closer.
"""

from __future__ import annotations

from itertools import chain

import numpy as np

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.descriptors import describe
from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.consensus import after_frame, without_moving
from stereo_sfm.tracking.flow.follower import Follower
from stereo_sfm.tracking.flow.frame_pose import ExpectedMotion, FramePoseSolver, PoseSolution
from stereo_sfm.tracking.flow.map_points import take_update
from stereo_sfm.tracking.flow.new_points import NewPoints
from stereo_sfm.tracking.flow.place_corners import PlaceCorners
from stereo_sfm.tracking.flow.pyramids import StereoPyramids
from stereo_sfm.tracking.flow.recovery import SUFFICIENT_SHARE, Recovery, within
from stereo_sfm.tracking.flow.rig_change import triangulate_tracks
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.side_views import SideViews
from stereo_sfm.tracking.flow.stereo import StereoMatcher
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.tracking.flow.trusted_motion import Expectation
from stereo_sfm.tracking.flow.visible_area import VisibleArea
from stereo_sfm.tracking.inertial.inertial_motion import InertialMotion
from stereo_sfm.tracking.protocol import Places
from stereo_sfm.types import F64, Bool, Corners, Frame, Keyframe, MapUpdate, Observations, StereoImage, TrackState

DARK = 30  # grey level; an image without a brighter pixel is dark
NOT_FOUND = (
    Tracks(),
    PoseSolution(np.eye(4), np.zeros(6), np.eye(6), np.zeros(0), 0.0, 0.0, "not_found"),
)
MAX_MISSES = 3  # successive frames after which a point that disagrees is given up
TRUSTED_SHARE = 0.8  # of the points that are followed: a pose that so many agree with is beyond doubt ...
TRUSTED_LEFT = 0.5  # ... if so many of the newest keyframe's points are left ...
TRUSTED_OPEN = 0.3  # ... and so many of those that agree in an open view
COVERED_SHARE = 0.1  # that a frame whose view is covered counts towards beginning anew
SAME_START = 0.05, 0.01  # metres, radians between poses from which the same is found
ROUNDS = 2
FIRST_COVARIANCE = np.eye(6) * 1e-12  # of the first pose, which is the odometry frame
UNKNOWN_COVARIANCE = np.eye(6)


class Tracker:
    """One `step` per image. Frame poses are odom_T_cam; the odometry frame is the first camera."""

    def __init__(
        self,
        config: TrackerConfig,
        rig: Rig,
        spans: NoSpans | None = None,
        place_corners: PlaceCorners | None = None,
        places: Places | None = None,
        side_views: SideViews | None = None,
    ) -> None:
        """Args:
        place_corners: detector of the corners for place recognition; None: keyframes have none.
        places: relocalization after a loss of tracking; None: there is none.
        side_views: views for place recognition in the opposite direction; None: keyframes have none.
        """
        self._config, self._rig = config, rig
        self._rig_terms: F64 = np.zeros(6)  # current correction of the rig
        self._spans = spans or NoSpans()
        self._stereo = StereoMatcher(config, rig)
        self._shutter = RollingShutter(rig)
        area = VisibleArea(rig.left, config.max_angle_deg, rig.left_mask)
        self._follower = Follower(config, rig, area, self._shutter)
        self._solver = FramePoseSolver(config, StereoCameras.of(rig), self._shutter)
        self._new_points = NewPoints(config, area, self._stereo, self._follower, self._shutter)
        self._place_corners, self._side_views = place_corners, side_views
        self._inertial = InertialMotion(rig.imu) if rig.imu is not None and config.inertial else None
        self._recovery = Recovery(place_corners, places, rig.left.size)
        self._tracks = Tracks()
        self._state = TrackState.INITIALIZING
        self._pose: F64 = np.eye(4)
        self._velocity: F64 = np.zeros(6)  # tangent per second
        self._stamp_ns = 0
        self._lost = 0  # successive frames
        self._searched = 0.0  # of these, those with a view to search in, weighted by COVERED_SHARE
        self._bridging = False  # tracking restarts at the pose by the IMU, in the same submap
        self._submap_id = 0
        self._next_kf_id = 0
        self._kf_pose: F64 = np.eye(4)
        self._kf_points = 0
        self._frames_since_kf = 0
        self._map_version = 0
        self.solution: PoseSolution | None = None  # of the last image; None for a first image

    @property
    def points(self) -> F64:
        """(N, 3) metres, odometry frame: the points of the last frame's observations, if it has a pose."""
        return self._tracks.points()

    def apply(self, update: MapUpdate) -> None:
        """Apply the mapper's positions of points, and its correction of the rig."""
        self._map_version = update.version
        if update.calibration is not None and update.calibration.applied:
            self._rig_terms = update.calibration.terms
            self._use(with_terms(self._rig, self._rig_terms))
        self._tracks = take_update(self._tracks, update)

    def step(self, image: StereoImage) -> tuple[Frame, Keyframe | None]:
        """The pose of one image, and the keyframe if this frame becomes one."""
        with self._spans.span("pyramid"):
            images = self._prepare(image)
        self.solution = None
        if self._inertial is not None:
            self._inertial.feed(image.imu)
        if self._state == TrackState.INITIALIZING:
            return self._begin(image, images)
        expected = self._predict(image.stamp_ns)
        blind = self._lost and self._inertial is None
        tracks, solution = NOT_FOUND if blind else self._follow(images, expected)
        if solution.reason:
            tracks, solution = self._search(image, images)
        self.solution = solution
        if solution.reason:
            return self._lose(image, solution.reason)
        self._solver.learn(tracks, solution, expected)
        self._solver.refine_depth(tracks, solution)
        state = TrackState.OK if self._lost == 0 else TrackState.RECOVERED
        stats = _stats(tracks, solution)
        agree = int((solution.inlier & ~tracks.moving).sum())
        enough = max(TRUSTED_LEFT * self._kf_points, TRUSTED_OPEN * self._solver.open_view)
        trusted = agree >= max(TRUSTED_SHARE * float((~tracks.moving).sum()), enough)
        if trusted:
            self._recovery.motion.add(image.stamp_ns, solution.pose)
            self._follower.hold(images.left, tracks.keep(solution.inlier & ~tracks.moving), solution.pose)
        again = bool(self._lost)
        inlier = self._accept(image, images, tracks, solution, expected.seconds)
        stats |= self._level()
        keyframe = None
        if again or self._wants_keyframe():
            with self._spans.span("keyframe"):
                inlier = self._add_points(images, inlier)
                keyframe = self._make_keyframe(image, images)
            if trusted:
                self._recovery.remember(keyframe)
        return self._frame(image, state, solution.covariance, inlier, keyframe, stats), keyframe

    def _use(self, rig: Rig) -> None:
        """Use a corrected rig: the tracked points are triangulated anew."""
        self._stereo.use(rig)
        self._solver.use(StereoCameras.of(rig))
        self._recovery.use(rig)
        if self._place_corners is not None:
            self._place_corners.use(rig)
        if self._side_views is not None:
            self._side_views.use(rig)
        self._tracks = triangulate_tracks(self._tracks, self._stereo, self._shutter, self._pose, self._velocity)

    # -- stages ----------------------------------------------------------------------------------------------------

    def _prepare(self, image: StereoImage) -> StereoPyramids:
        left = klt.build_pyramid(image.left, self._config.pyramid_levels)
        return StereoPyramids(left, self._stereo.prepare(image))

    def _predict(self, stamp_ns: int) -> ExpectedMotion:
        """By the IMU, else constant velocity."""
        seconds = (stamp_ns - self._stamp_ns) * 1e-9
        moved = self._velocity * seconds
        pose = self._pose @ se3.exp(moved)
        if self._inertial is not None:
            pose = self._inertial.predict(stamp_ns, pose)
            moved = se3.log(se3.inverse(self._pose) @ pose)
        return ExpectedMotion(pose, moved, seconds)

    def _follow(self, images: StereoPyramids, expected: ExpectedMotion) -> tuple[Tracks, PoseSolution]:
        """Track the points of the last image, from the prediction or from the rotation of the whole image."""
        tracks, solution = self._track(images, expected)
        if solution.good(self._config, self._static_count()):
            return tracks, solution
        turned = self._follower.turned(images.left, expected, self._pose)
        return max((tracks, solution), self._track(images, turned), key=lambda found: found[1].inliers)

    def _track(self, images: StereoPyramids, expected: ExpectedMotion) -> tuple[Tracks, PoseSolution]:
        """Track all points from their predictions, match them in the right image and solve for the pose."""
        with self._spans.span("flow"):
            tracks = self._follower.follow(self._tracks, images.left, expected)
        with self._spans.span("stereo"):
            tracks.uv_right = self._stereo.follow(images.left, images.right, tracks.uv, tracks.points(), expected.pose)
        with self._spans.span("pose"):
            return tracks, self._solver.solve(tracks, expected, self._pose, self._static_count())

    def _accept(
        self, image: StereoImage, images: StereoPyramids, tracks: Tracks, solution: PoseSolution, seconds: float
    ) -> Bool:
        """Update the state with the image's pose; returns which of the remaining points (N,) are inliers."""
        if seconds > 0:
            mean = se3.log(se3.inverse(self._pose) @ solution.pose) / seconds
            self._shutter.learn(mean, seconds)
            self._velocity = solution.velocity if self._shutter.active else mean
        if self._lost:
            self._velocity = self._recovery.motion.velocity()
        inlier = solution.inlier & ~tracks.moving
        tracks.age = tracks.age + np.int32(1)
        tracks, kept = after_frame(tracks, solution.inlier, solution.moving, MAX_MISSES, self._solver.alert)
        self._continue(image, images, solution.pose, tracks)
        if self._inertial is not None:
            self._inertial.accept(image.stamp_ns, solution.pose)
        self._frames_since_kf += 1
        return inlier[kept]

    def _level(self) -> dict[str, float]:
        """Roll and pitch if gravity is known."""
        level = None if self._inertial is None else self._inertial.level(self._pose)
        return {} if level is None else {"roll_deg": level[0], "pitch_deg": level[1]}

    def _continue(self, image: StereoImage, images: StereoPyramids, pose: F64, tracks: Tracks) -> None:
        self._pose, self._stamp_ns, self._tracks = pose, image.stamp_ns, tracks
        self._state, self._lost, self._searched = TrackState.OK, 0, 0.0
        self._follower.accept(images.left, tracks)

    def _begin(self, image: StereoImage, images: StereoPyramids) -> tuple[Frame, Keyframe | None]:
        """The first frame, or the first after a restart: points from stereo alone."""
        bridge = self._bridge(image.stamp_ns) if self._bridging else None
        if self._bridging and bridge is None:  # for too long
            self._bridging = False
            self._submap_id += 1
        if bridge is not None:
            self._pose = bridge[0]
        self._continue(image, images, self._pose, Tracks())
        inlier = self._add_points(images, np.zeros(0, bool))
        if len(self._tracks) < 2 * self._config.min_features:
            self._tracks = Tracks()
            self._state = TrackState.INITIALIZING
            never = self._submap_id == 0 and self._next_kf_id == 0
            state = TrackState.INITIALIZING if never else TrackState.LOST
            state, covariance = (state, UNKNOWN_COVARIANCE) if bridge is None else (TrackState.INERTIAL, bridge[1])
            return self._without_pose(image, self._pose, state, "too_few_points", covariance), None
        first = self._next_kf_id == 0
        keyframe = self._make_keyframe(image, images)
        self._recovery.motion.add(image.stamp_ns, self._pose)
        self._recovery.remember(keyframe)
        self._follower.hold(images.left, self._tracks, self._pose)
        state = TrackState.OK if first else TrackState.RECOVERED if self._bridging else TrackState.RESTARTED
        covariance = FIRST_COVARIANCE if bridge is None else bridge[1]
        self._bridging = False
        if self._inertial is not None:
            self._inertial.begin(image.stamp_ns, self._pose)
        n = float(len(inlier))
        stats = {"tracked": n, "inliers": n, "right": n, "error": 0.0}
        return self._frame(image, state, covariance, inlier, keyframe, stats), keyframe

    def _bridge(self, stamp_ns: int) -> tuple[F64, F64] | None:
        """Pose (4, 4) and covariance (6, 6) by the IMU since the last good pose; None if it is not accurate enough."""
        if self._inertial is None or not self._inertial.bridges(stamp_ns):
            return None
        covariance = self._inertial.covariance(stamp_ns)
        assert covariance is not None
        return self._inertial.predict(stamp_ns, self._pose), covariance

    def _expect(self, stamp_ns: int) -> Expectation:
        """The predicted pose of a lost camera: by the IMU, else by the last trusted motion."""
        bridge = self._bridge(stamp_ns)
        return self._recovery.motion.expect(stamp_ns) if bridge is None else Expectation.of(*bridge)

    def _search(self, image: StereoImage, images: StereoPyramids) -> tuple[Tracks, PoseSolution]:
        """Relocalize a lost camera with the points of the last trusted image, from several hypotheses of its pose."""
        expected = self._expect(image.stamp_ns)
        seconds = (image.stamp_ns - self._stamp_ns) * 1e-9
        tried: list[F64] = []
        found: list[tuple[Tracks, PoseSolution]] = []
        for pose in chain([expected.odom_T_cam], self._recovery.search(image, images, expected)):
            if not any(within(pose, other, *SAME_START) for other in tried):
                tried.append(pose)
                tracks, solution = self._track_from(pose, images, seconds)
                visible = self._follower.expected_again(solution.pose)
                if self._recovery.possible(expected, solution, visible):
                    found.append((tracks, solution))
                    if solution.inliers >= SUFFICIENT_SHARE * visible:
                        break
        return self._recovery.best(found) or NOT_FOUND

    def _track_from(self, pose: F64, images: StereoPyramids, seconds: float) -> tuple[Tracks, PoseSolution]:
        """Track the points of the last trusted image from an approximate pose (4, 4), and again from the result."""
        tracks, solution = NOT_FOUND
        for _ in range(ROUNDS):
            motion = ExpectedMotion(pose, se3.log(se3.inverse(self._pose) @ pose), seconds)
            tracks = self._follower.find_again(images.left, motion)
            tracks.uv_right = self._stereo.follow(images.left, images.right, tracks.uv, tracks.points(), pose)
            solution = self._solver.solve(tracks, motion, pose)
            if solution.reason:
                break
            pose = solution.pose
        return tracks, solution

    def _lose(self, image: StereoImage, reason: str) -> tuple[Frame, None]:
        """Predict the pose; after some frames with a free view start a new submap."""
        expected = self._expect(image.stamp_ns)
        self._lost += 1
        self._follower.search_widely()
        bridge = self._bridge(image.stamp_ns)
        seen = bridge is None or image.left.max() >= DARK
        self._searched += seen * (1.0 if self._recovery.free else COVERED_SHARE)
        if self._searched > self._config.lost_frames:
            self._pose = expected.odom_T_cam
            self._velocity = np.zeros(6)
            self._bridging = bridge is not None
            self._submap_id += not self._bridging
            self._state = TrackState.INITIALIZING
            if not self._bridging:
                self._recovery.motion.forget()
        covered = not self._recovery.free and image.left.max() >= DARK
        state = TrackState.OCCLUDED if covered else TrackState.LOST
        state = state if bridge is None else TrackState.INERTIAL
        covariance = expected.covariance if bridge is None else bridge[1]
        return self._without_pose(image, expected.odom_T_cam, state, reason, covariance), None

    def _add_points(self, images: StereoPyramids, inlier: Bool) -> Bool:
        """Add new points after the tracked ones, of which `inlier` (N,) are inliers; returns the mask of all."""
        self._tracks = self._new_points.add(self._tracks, images, self._pose, self._velocity)
        return np.concatenate([inlier, ~self._tracks.moving[len(inlier) :]])

    # -- messages --------------------------------------------------------------------------------------------------

    def _wants_keyframe(self) -> bool:
        config = self._config
        left = self._static_count()  # new points come with keyframes only
        return self._frames_since_kf >= config.keyframe_max_frames or left < config.keyframe_share * self._kf_points

    def _static_count(self) -> int:
        """Number of tracked points that are not on moving objects."""
        return int((~self._tracks.moving).sum())

    def _make_keyframe(self, image: StereoImage, images: StereoPyramids) -> Keyframe:
        tracks = self._tracks.keep(~self._tracks.moving)
        points_cam = se3.transform(se3.inverse(self._pose), tracks.points())
        corners = sides = Corners.none()
        if self._place_corners is not None:
            corners = self._place_corners.find_in(images.left, images.right)
            corners = without_moving(corners, self._tracks)
        if self._side_views is not None:
            sides = self._side_views.find(images.left, images.right, corners, self._pose, self._submap_id)
            sides = without_moving(sides, self._tracks)
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
            descriptors=describe(images.left[0], tracks.uv),
            submap_id=self._submap_id,
            corners=self._shutter.corners_at_stamp(corners, self._velocity),
            rig_terms=self._rig_terms.copy(),
            sides=self._shutter.corners_at_stamp(sides, self._velocity),
        )
        self._next_kf_id += 1
        self._kf_pose = self._pose.copy()
        self._kf_points = self._static_count()
        self._frames_since_kf = 0
        return keyframe

    def _frame(
        self,
        image: StereoImage,
        state: TrackState,
        covariance: F64,
        inlier: Bool,
        keyframe: Keyframe | None,
        stats: dict[str, float],
    ) -> Frame:
        """A frame with a pose."""
        tracks = self._tracks
        return Frame(
            frame_id=image.frame_id,
            stamp_ns=image.stamp_ns,
            odom_T_cam=self._pose.copy(),
            covariance=covariance.copy(),
            state=state,
            reason="",
            observations=Observations(
                tracks.point_ids.copy(), tracks.uv.copy(), tracks.uv_right.copy(), tracks.age.copy(), inlier
            ),
            reference_kf_id=self._next_kf_id - 1,
            kf_T_cam=se3.inverse(self._kf_pose) @ self._pose,
            map_version=self._map_version,
            is_keyframe=keyframe is not None,
            stats=stats,
        )

    def _without_pose(
        self,
        image: StereoImage,
        predicted: F64,
        state: TrackState,
        reason: str,
        covariance: F64 = UNKNOWN_COVARIANCE,
    ) -> Frame:
        """A frame without a pose from its image: predicted, or by the IMU."""
        return Frame(
            frame_id=image.frame_id,
            stamp_ns=image.stamp_ns,
            odom_T_cam=predicted.copy(),
            covariance=covariance.copy(),
            state=state,
            reason="dark" if image.left.max() < DARK else reason,
            observations=Observations.empty(),
            reference_kf_id=self._next_kf_id - 1,
            kf_T_cam=se3.inverse(self._kf_pose) @ predicted,
            map_version=self._map_version,
        )


def _stats(tracks: Tracks, solution: PoseSolution) -> dict[str, float]:
    """Statistics of a frame for plots."""
    return {
        "tracked": float(len(tracks)),
        "inliers": float((solution.inlier & ~tracks.moving).sum()),
        "moving": float(tracks.moving.mean()) if len(tracks) else 0.0,
        "right": float(np.isfinite(tracks.uv_right[:, 0]).sum()),
        "error": float(np.median(solution.error[solution.inlier])),
    }
