"""The default tracker: flow of grid-spread points, stereo by bearings, motion-only optimisation over both images.

Per frame: predict the pose (constant velocity), predict every point's pixel, follow it by translation, align it with
its first appearance, match it in the right image, solve for the pose robustly, refine the points' distances. At
keyframes, after their pose: new corners where points are missing, stereo matches for them, descriptors for the mapper;
corners of the whole image for the loop closer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.sensor_terms import with_sensor_terms
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.order_statistics import median
from stereo_sfm.pixels import DARK
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.consensus import TRUSTED_OPEN, TRUSTED_SHARE, Movers, after_frame, static_frames
from stereo_sfm.tracking.flow.follower import Follower
from stereo_sfm.tracking.flow.frame_pose import ExpectedMotion, FramePoseSolver, PoseSolution, no_pose
from stereo_sfm.tracking.flow.keyframes import Keyframes
from stereo_sfm.tracking.flow.klt import StereoPyramids
from stereo_sfm.tracking.flow.loss import Loss
from stereo_sfm.tracking.flow.map_points import take_update
from stereo_sfm.tracking.flow.motion_prior import Expectation
from stereo_sfm.tracking.flow.new_points import NewPoints
from stereo_sfm.tracking.flow.partial_view import PartialView
from stereo_sfm.tracking.flow.place_corners import PlaceCorners
from stereo_sfm.tracking.flow.readout import ReadoutSearch
from stereo_sfm.tracking.flow.recovery import SAME_PLACE, SUFFICIENT_RECALL, Recovery
from stereo_sfm.tracking.flow.rolling_shutter import MIN_INTERVAL_S, RollingShutter
from stereo_sfm.tracking.flow.side_views import SideViews
from stereo_sfm.tracking.flow.stereo import StereoMatcher
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.sudden_turn import DECIDED, SuddenTurns
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.tracking.flow.visible_area import VisibleArea
from stereo_sfm.tracking.inertial.motion_sensors import MotionSensors
from stereo_sfm.tracking.protocol import Places
from stereo_sfm.types import F64, RIG_TERMS, Bool, Frame, Keyframe, MapUpdate, Observations, StereoImage, TrackState

NOT_FOUND = Tracks(), no_pose(0, "not_found")  # the result without points
MAX_MISSES = 3  # successive frames after which a point that disagrees is given up
TRUSTED_LEFT = 0.5  # of the newest keyframe's points, with which a pose may be beyond doubt
SAME_START = 0.05, 0.01  # metres, radians between poses from which the same is found
UNSEEN_NS = 2_000_000_000  # for which a camera may be covered while the robot drives on
REFERENCE_NS = 200_000_000  # from one image that may become the reference to the next
SHORT = 0.4  # of the usual interval between images, of which each second one may be missing: shorter is a clock's error
USUAL = 15  # intervals whose median is the usual one
ROUNDS = (0.066, 160), (0.03, 400), (0.015, 1000)  # of a search: reach as a share of the width, most points
CELLS_PER_METRE = 3.0  # of the image that must agree, per metre of standard deviation of the prediction
REFERENCE_POINTS = 8  # times max_features, of the image to recover from: after two metres little of it is still in view
FIRST_COVARIANCE = np.eye(6) * 1e-12  # of the first pose, which is the odometry frame
FOLLOWED_S = 0.5  # without a pose: with 2 m/s^2, a robot is a quarter of a metre from where it was expected
FIRST_ROUNDS = 3  # of the first velocity of a rolling shutter; a fourth changed turns of 12 to 74 deg/s by 0.06 at most
FEW_RIGHT = 0.75  # of the share of points that had a right pixel before: they are looked for farther away ...
RIGHT_LEVEL = 2  # ... from this level of the pyramids on


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
        sudden: SuddenTurns | None = None,
        readout: ReadoutSearch | None = None,
    ) -> None:
        """Args:
        place_corners: detector of the corners for place recognition; None: keyframes have none.
        places: relocalization after a loss of tracking; None: there is none.
        side_views: views for place recognition in the opposite direction; None: keyframes have none.
        sudden: None: the mapper does not correct the rig.
        readout: None: the readout is the calibration's.
        """
        self._config, self._rig, self._readout = config, rig, readout
        self._rig_terms: F64 = np.zeros(RIG_TERMS)  # current correction of the rig
        self._sudden = sudden
        self._spans = spans or NoSpans()
        self._stereo = StereoMatcher(config, rig)
        self._shutter = RollingShutter(rig)
        area = VisibleArea(rig.left, config.max_angle_deg, rig.left_mask)
        self._follower = Follower(config, rig, area, self._shutter)
        self._solver = FramePoseSolver(config, StereoCameras.of(rig), self._shutter)
        self._movers = Movers()
        self._new_points = NewPoints(config, area, self._stereo, self._follower, self._shutter, self._movers)
        self._keyframes = Keyframes(config, self._shutter, place_corners, side_views, self._movers)
        self._sensors = MotionSensors.of(config, rig)
        self._reference_ns = -REFERENCE_NS  # the last image that might have become the reference
        self._recovery = Recovery(place_corners, places, rig.left.size)
        self._tracks = Tracks()
        self._state = TrackState.INITIALIZING
        self._pose: F64 = np.eye(4)
        self._velocity: F64 = np.zeros(6)  # tangent per second
        self._stamp_ns = 0
        self._intervals: deque[float] = deque(maxlen=USUAL)  # seconds between the last images
        self._loss = Loss(config.lost_s)
        self._part = PartialView()
        self._bridging = False  # tracking restarts at the pose by IMU or wheels, in the same submap
        self._submap_id = 0
        self._map_version = 0
        self._resumed_T_odom: F64 = np.eye(4)  # for points of the map, since the rig was corrected: see `_resume`
        self._undescribed: tuple[Keyframe, StereoPyramids, bool] | None = None  # the newest keyframe, and if trusted
        self._sparse: StereoPyramids | None = None  # images of the newest frame if it needs new points
        self.solution: PoseSolution | None = None  # of the last image; None for a first image

    @property
    def points(self) -> F64:
        """(N, 3) metres, odometry frame: the points of the last frame's observations, if it has a pose."""
        return self._tracks.points()

    def apply(self, update: MapUpdate) -> None:
        """Apply the mapper's positions of points, and its correction of the rig."""
        self._map_version = update.version
        if self._keyframes.resumed(update.kf_id):
            self._resumed_T_odom = np.eye(4)
        if self._sensors is not None and update.sensors is not None:
            self._sensors.use(update.sensors, with_sensor_terms(self._rig, update.sensors))
        corrected = update.calibration is not None and update.calibration.applied
        if update.calibration is not None and corrected:
            if self._sudden is not None and update.calibration.why == "step":
                self._sudden.confirmed((update.calibration.terms - self._rig_terms)[:3])
            self._rig_terms = update.calibration.terms
            self._use_rig()
            self._new_points.triangulate_again(self._tracks, self._pose, self._velocity)
        elif self._sudden is not None and self._turn.any():  # the map does not know it yet
            if self._keyframes.shown(self._turn, update.kf_id) > DECIDED:
                self._sudden.refused()
                self._use_rig()
                self._new_points.triangulate_again(self._tracks, self._pose, self._velocity)
            update = replace(update, point_ids=update.point_ids[:0], points_map=update.points_map[:0])
        self._tracks = take_update(self._tracks, update, self._resumed_T_odom)
        if corrected and not self._loss.frames:
            self._resume(update)

    def step(self, image: StereoImage) -> tuple[Frame, Keyframe | None]:
        """The pose of one image, and the keyframe if this frame becomes one, still without points: see `describe`."""
        self._complete()
        self._undescribed = None
        with self._spans.span("pyramid"):
            images = self._prepare(image)
        self.solution = None
        if self._sensors is not None:
            self._sensors.feed(image)
        if self._state == TrackState.INITIALIZING:
            return self._begin(image, images)
        expected = self._predict(image.stamp_ns)
        # Who was covered for longer may be elsewhere: what is followed from the last image then is found by chance.
        long_lost = (image.stamp_ns - self._stamp_ns) * 1e-9 > FOLLOWED_S
        blind = self._loss.frames and long_lost and self._bridge(image.stamp_ns) is None
        tracks, solution = NOT_FOUND if blind else self._follow(images, expected)
        recovered = bool(self._loss.frames or solution.reason)
        if solution.reason:
            tracks, solution = self._search(image, images)
        if not (recovered or solution.reason) and (more := self._find_more(image, images, solution.pose)) is not None:
            (tracks, solution), recovered = more, True
        if solution.reason:
            return self._lose(image, solution.reason)
        self.solution = solution
        if self._sensors is not None:
            solution.pose = self._sensors.corrected(image.stamp_ns, solution.pose, solution.covariance)
        timed = self._timed(expected.seconds)
        self._refine(tracks, solution, expected, recovered or not timed)
        trusted = self._trusted(tracks, solution)
        if trusted or self._recovery.motion.stale(image.stamp_ns):
            self._recovery.motion.add(image.stamp_ns, solution.pose, trusted)
        if trusted:
            self._renew_reference(image, images, tracks, solution)
        stats = _stats(tracks, solution)
        inlier = self._accept(image, images, tracks, solution, expected.seconds, recovered, timed)
        if self._readout is not None:
            self._readout.add(image.stamp_ns, self._pose, self._tracks, inlier)
            self._use_readout(self._readout)
        keyframe = None
        if recovered or self._keyframes.due(self._tracks):
            keyframe = self._create_keyframe(image, images, solution.covariance, trusted)
        if keyframe is not None or self._solver.crowded(self._static_count()):
            self._sparse = images
        state = TrackState.RECOVERED if recovered else TrackState.OK
        stats |= {} if self._sensors is None else self._sensors.level(self._pose) | self._sensors.use_of_each()
        news = (watched.news() for watched in (self._sudden, self._sensors, self._readout) if watched is not None)
        reason = next(filter(None, news), "")
        return self._frame(image, self._pose, solution.covariance, state, reason, inlier, keyframe, stats), keyframe

    def describe(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe of the last step with its points, descriptors and corners, for the mapper and the loop closer.

        This takes as long as several steps, and the pose does not wait for it. A keyframe that is not described is not
        searched after a loss of tracking.
        """
        self._complete()
        assert self._undescribed is not None
        own, images, trusted = self._undescribed
        self._undescribed = None
        with self._spans.span("describe"):
            own = self._keyframes.describe(own, images, self._tracks, self._velocity)
            if trusted:
                self._recovery.remember(own)
        return replace(own, odom_T_cam=keyframe.odom_T_cam)

    def _complete(self) -> None:
        """Add new points to the newest frame if it needs them, and has not got them."""
        if self._sparse is not None:
            with self._spans.span("keyframe"):
                self._add_points(self._sparse)
            self._sparse = None
            if self._undescribed is not None:
                self._keyframes.points = self._static_count()

    @property
    def _turn(self) -> F64:
        """(3,) by which the right camera has turned suddenly, which the rig's correction does not contain."""
        return np.zeros(3) if self._sudden is None else self._sudden.turn

    def _use_rig(self) -> None:
        """Use the rig as it is now known."""
        terms = self._rig_terms.copy()
        terms[:3] += self._turn
        rig = with_terms(self._rig, terms)
        self._stereo.use(rig)
        self._solver.use(StereoCameras.of(rig))
        self._recovery.use(rig)
        self._keyframes.use(rig)

    def _resume(self, update: MapUpdate) -> None:
        """Go on from the last pose with the points of an update that corrects the rig.

        The motion since the newest keyframe was measured with another rig: points triangulated from the last pose
        contradict those of the map. The odometry does not jump; the map's points move to where the last image saw them
        from its pose, until the map has a keyframe that knows.
        """
        placed = self._tracks.keep(self._tracks.mapped)
        solution = self._solver.solve_again(placed, ExpectedMotion(self._pose, np.zeros(6), 0.0))
        if not solution.reason and solution.consistent:
            self._resumed_T_odom = self._pose @ se3.inverse(solution.pose) @ self._resumed_T_odom
            self._tracks = take_update(self._tracks, update, self._resumed_T_odom)

    def _after_sudden_turn(
        self, tracks: Tracks, solution: PoseSolution | None, images: StereoPyramids, expected: ExpectedMotion
    ) -> tuple[Tracks, PoseSolution] | None:
        """The pose of an image in which the right camera has turned suddenly; None if it has not.

        `tracks`, `solution`: without that; None where it is not good, and one from the left image alone is tried.
        """
        if self._sudden is None:
            return None
        found, before = (np.isfinite(t.uv_right[:, 0]).mean() if len(t) else 0.0 for t in (tracks, self._tracks))
        if found < FEW_RIGHT * before:
            tracks = self._match_right(tracks, images, expected, RIGHT_LEVEL)
        if solution is None:
            by_left = replace(tracks, uv_right=np.full_like(tracks.uv_right, np.nan))
            solution = self._solver.solve(by_left, expected, self._pose, self._static_count())
            if not solution.good(self._config, self._static_count()):
                return None
        if not self._sudden.seen(self._tracks, self._pose, tracks, solution.pose, self._solver.cameras):
            return None
        self._use_rig()
        return self._track(images, expected)

    def _use_readout(self, readout: ReadoutSearch) -> None:
        """Use the readout as it is now known; a first one places the points anew.

        Where most of them contradicted a global shutter, what was taken for moving may be at rest.
        """
        rolls = self._shutter.active
        self._shutter.use(readout.used_s)
        if self._shutter.active == rolls:
            return
        self._new_points.triangulate_again(self._tracks, self._pose, self._velocity, not readout.few_agree)
        if readout.few_agree:
            self._solver.forget()
            self._movers.forget()

    # -- stages ----------------------------------------------------------------------------------------------------

    def _prepare(self, image: StereoImage) -> StereoPyramids:
        left = klt.build_pyramid(image.left, self._config.pyramid_levels)
        return StereoPyramids(left, self._stereo.prepare(image))

    def _predict(self, stamp_ns: int) -> ExpectedMotion:
        """By IMU and wheels, else constant velocity."""
        seconds = (stamp_ns - self._stamp_ns) * 1e-9
        moved = self._velocity * seconds
        if self._sensors is None:
            return ExpectedMotion(self._pose @ se3.exp(moved), moved, seconds)
        pose = self._sensors.predict(stamp_ns, self._pose, moved)
        return ExpectedMotion(pose, se3.log(se3.inverse(self._pose) @ pose), seconds)

    def _follow(self, images: StereoPyramids, expected: ExpectedMotion) -> tuple[Tracks, PoseSolution]:
        """Track the points of the last image, from the prediction or from the rotation of the whole image.

        If both fail and most points are still found by translation, then the image is blurred.
        """
        tracks, solution = self._track(images, expected)
        good = solution.good(self._config, self._static_count())
        turned_suddenly = self._after_sudden_turn(tracks, solution if good else None, images, expected)
        if turned_suddenly is not None:
            return turned_suddenly
        if good:
            return tracks, solution
        for anywhere in (False, True):
            turned = self._follower.turned(images.left, expected, self._pose, anywhere)
            tracks, solution = self._solver.better([(tracks, solution), self._track(images, turned)], expected)
            if solution.good(self._config, self._static_count()):
                return tracks, solution
        self._follower.search_widely()
        blurred = self._track(images, turned, blurred=True)
        consistent = blurred[1].good(self._config, self._static_count()) and blurred[1].consistent
        return blurred if consistent else (tracks, solution)

    def _track(
        self, images: StereoPyramids, expected: ExpectedMotion, blurred: bool = False
    ) -> tuple[Tracks, PoseSolution]:
        """Track all points from their predictions, match them in the right image and solve for the pose.

        `blurred`: see `Follower.follow`.
        """
        with self._spans.span("flow"):
            tracks = self._follower.follow(self._tracks, self._pose, images.left, expected, blurred)
        tracks = self._match_right(tracks, images, expected)
        with self._spans.span("pose"):
            return tracks, self._solver.solve(tracks, expected, self._pose, self._static_count(), blurred)

    def _match_right(self, tracks: Tracks, images: StereoPyramids, expected: ExpectedMotion, level: int = 0) -> Tracks:
        """The tracks with their right pixels, looked for from a level of the pyramid on: the higher, the farther."""
        with self._spans.span("stereo"):
            uv_right = self._stereo.follow(
                images.left, images.right, tracks.uv, tracks.points(), expected.pose, tracks.right_offset, level
            )
        return replace(tracks, uv_right=uv_right)

    def _refine(self, tracks: Tracks, solution: PoseSolution, expected: ExpectedMotion, recovered: bool) -> None:
        """Unless the pose was just recovered, learn the noise of points and motion; refine the inliers' distances.

        Points of a blurred image are good for a pose only.
        """
        if solution.blurred:
            return
        if not recovered:
            self._solver.learn(tracks, solution, expected)
        self._solver.refine_depth(tracks, solution)

    def _trusted(self, tracks: Tracks, solution: PoseSolution) -> bool:
        """Whether so many points of a sharp image agree with a pose that it is beyond doubt."""
        if solution.blurred:
            return False
        agree = int(np.count_nonzero(solution.inlier & ~tracks.moving))
        enough = max(TRUSTED_LEFT * self._keyframes.points, TRUSTED_OPEN * self._solver.open_view)
        return agree >= max(TRUSTED_SHARE * int(np.count_nonzero(~tracks.moving)), enough)

    def _accept(
        self,
        image: StereoImage,
        images: StereoPyramids,
        tracks: Tracks,
        solution: PoseSolution,
        seconds: float,
        recovered: bool,
        timed: bool,
    ) -> Bool:
        """Update the state with the image's pose; returns which of the remaining points (N,) are inliers.

        `recovered`: the pose was searched for. `timed`: the motion since the last image took `seconds`.
        """
        if recovered or not timed:
            self._velocity = self._recovery.motion.velocity()
        elif seconds > 0:
            mean = se3.log(se3.inverse(self._pose) @ solution.pose) / seconds
            self._shutter.learn(mean, seconds)
            self._velocity = solution.velocity if self._shutter.active else mean
        inlier = solution.inlier & ~tracks.moving
        self._loss.followed()
        tracks.age = tracks.age + np.int32(1)
        static = static_frames(max(seconds, SHORT * self._usual_s))
        tracks, kept = after_frame(tracks, solution.inlier, solution.moving, MAX_MISSES, self._solver.alert, static)
        self._movers.update(self._tracks, tracks, self._rig.left, solution.pose)
        self._continue(image, images, solution.pose, tracks)
        if self._sensors is not None:
            self._sensors.accept(image.stamp_ns, solution.pose, timed)
        self._keyframes.count_frame(seconds if recovered or 2 * np.count_nonzero(inlier) < len(inlier) else 0.0)
        return inlier[kept]

    def _timed(self, seconds: float) -> bool:
        """Whether the interval since the last image tells how fast the camera moves; clocks of computers hiccup."""
        self._intervals.append(seconds)
        return seconds > SHORT * self._usual_s

    @property
    def _usual_s(self) -> float:
        """The usual interval between images."""
        return median(np.array(self._intervals))

    def _continue(self, image: StereoImage, images: StereoPyramids, pose: F64, tracks: Tracks) -> None:
        self._pose, self._stamp_ns, self._tracks = pose, image.stamp_ns, tracks
        self._state = TrackState.OK
        self._loss.end()
        self._follower.accept(images.left, tracks)

    def _begin(self, image: StereoImage, images: StereoPyramids) -> tuple[Frame, Keyframe | None]:
        """The first frame, or the first after a restart: points from stereo alone.

        With a rolling shutter the image before it tells how fast the camera moves, which places the rows of its points.
        """
        measured = self._shutter.active and len(self._tracks) > 0
        if measured:
            self._velocity = self._first_velocity(images, image.stamp_ns)
        bridge = self._bridge(image.stamp_ns) if self._bridging else None
        if self._bridging and bridge is None:  # for too long
            self._bridging = False
            self._submap_id += 1
        if bridge is not None:
            self._pose = bridge[0]
        self._continue(image, images, self._pose, Tracks())
        self._add_points(images)
        few = len(self._tracks) < 2 * self._config.min_features
        if few or (self._shutter.active and not measured):
            self._tracks = Tracks() if few else self._tracks
            self._state = TrackState.INITIALIZING
            never = self._submap_id == 0 and self._keyframes.count == 0
            state = TrackState.INITIALIZING if never else TrackState.LOST
            # Without sensors a metre and a radian: the odometry has not begun.
            state, covariance = (state, np.eye(6)) if bridge is None else (TrackState.INERTIAL, bridge[1])
            return self._frame(image, self._pose, covariance, state, "too_few_points" if few else "first_image"), None
        first = self._keyframes.count == 0
        covariance = FIRST_COVARIANCE if bridge is None else bridge[1]
        keyframe = self._create_keyframe(image, images, covariance, True)
        self._recovery.motion.add(image.stamp_ns, self._pose)
        self._follower.forget()
        self._follower.refer_to(images, self._tracks, ~self._tracks.moving, self._pose, self._pose)
        self._reference_ns = image.stamp_ns
        self._loss.begin(image.stamp_ns)
        state = TrackState.OK if first else TrackState.RECOVERED if self._bridging else TrackState.RESTARTED
        self._bridging = False
        if self._sensors is not None:
            self._sensors.begin(image.stamp_ns, self._pose)
        inlier = ~self._tracks.moving
        n = float(len(inlier))
        stats = {"tracked": n, "inliers": n, "right": n, "error": 0.0}
        return self._frame(image, self._pose, covariance, state, "", inlier, keyframe, stats), keyframe

    def _first_velocity(self, images: StereoPyramids, stamp_ns: int) -> F64:
        """(6,) mean velocity from the image before to this one, with a rolling shutter; zero if it is not found.

        It moves the rows of the image before, too: found with these at rest, then with the velocity so found.
        """
        for _ in range(FIRST_ROUNDS):
            expected = self._predict(stamp_ns)
            solution = self._follow(images, expected)[1]
            if solution.reason or expected.seconds < MIN_INTERVAL_S:
                return np.zeros(6)
            self._velocity = se3.log(se3.inverse(self._pose) @ solution.pose) / expected.seconds
            self._new_points.triangulate_again(self._tracks, self._pose, self._velocity)
        return self._velocity

    def _bridge(self, stamp_ns: int) -> tuple[F64, F64] | None:
        """Pose (4, 4) and covariance (6, 6) by IMU and wheels since the last good pose; None if not accurate enough."""
        return None if self._sensors is None else self._sensors.bridge(stamp_ns)

    def _expect(self, stamp_ns: int, bridge: tuple[F64, F64] | None) -> Expectation:
        """The predicted pose of a lost camera: by IMU and wheels, else by the motion prior."""
        return self._recovery.motion.expect(stamp_ns) if bridge is None else Expectation.of(*bridge)

    def _search(self, image: StereoImage, images: StereoPyramids) -> tuple[Tracks, PoseSolution]:
        """Relocalize a lost camera with the points of the last trusted image, from several hypotheses of its pose."""
        self._add_to_reference()
        bridge = self._bridge(image.stamp_ns)
        expected = self._expect(image.stamp_ns, bridge)
        steady = self._recovery.motion.steady(image.stamp_ns) if bridge is None else None
        seconds = (image.stamp_ns - self._stamp_ns) * 1e-9
        tried, refined, seen = list[F64](), list[F64](), None
        found: list[tuple[Tracks, PoseSolution, float]] = []
        for pose in chain([expected.odom_T_cam], self._recovery.search(image, images, expected)):
            if not any(se3.within(pose, other, *SAME_START) for other in tried):
                tried.append(pose)
                tracks, solution = self._track_from(pose, images, seconds, refined)
                if solution.reason:
                    continue
                refined.append(solution.pose)
                seen = self._new_points.seen(images) if seen is None else seen
                found_again, recall = tracks.uv[solution.inlier], self._recall(tracks, solution)
                uncovered = self._follower.recall(found_again, solution.pose, seen, CELLS_PER_METRE * expected.sigma_m)
                if self._recovery.possible(expected, solution, uncovered, steady):
                    found.append((tracks, solution, recall))
                    if recall >= SUFFICIENT_RECALL:
                        break
        best = self._recovery.best(found)
        if best is None:
            return NOT_FOUND
        tracks, solution, recall = best
        self._part.begin(self._follower.reference, recall, solution.covariance, image.stamp_ns)
        return tracks, solution

    def _find_more(self, image: StereoImage, images: StereoPyramids, pose: F64) -> tuple[Tracks, PoseSolution] | None:
        """Relocalize again, near a pose (4, 4) from a part of the view, once more is free; None if no more is found."""
        if not self._part.wanted(self._follower.reference, image.stamp_ns):
            return None
        tracks, solution = self._track_from(pose, images, (image.stamp_ns - self._stamp_ns) * 1e-9)
        if solution.reason:
            return None
        recall = self._recall(tracks, solution)
        if not self._part.improved(pose, solution.pose, recall, solution.covariance):
            self._part.end(recall)
            return None
        self._part.begin(self._follower.reference, recall, solution.covariance, image.stamp_ns)
        return tracks, solution

    def _recall(self, tracks: Tracks, solution: PoseSolution) -> float:
        """`Follower.recall` of the points that agree with a pose."""
        return self._follower.recall(tracks.uv[solution.inlier], solution.pose)

    def _track_from(
        self, pose: F64, images: StereoPyramids, seconds: float, known: Sequence[F64] = ()
    ) -> tuple[Tracks, PoseSolution]:
        """Find the points of the reference image from an approximate pose (4, 4), and again from the results.

        No pose is found where the first result is near a `known` one (4, 4), to which the others would lead again.
        """
        tracks, solution = NOT_FOUND
        for reach, most in ROUNDS:
            motion = ExpectedMotion(pose, se3.log(se3.inverse(self._pose) @ pose), seconds)
            tracks = self._match_right(self._follower.find_again(images.left, pose, reach, most), images, motion)
            solution = self._solver.solve_again(tracks, motion)
            if solution.reason or any(se3.within(solution.pose, other, *SAME_PLACE) for other in known):
                return NOT_FOUND
            pose, known = solution.pose, ()
        return tracks, solution

    def _renew_reference(
        self, image: StereoImage, images: StereoPyramids, tracks: Tracks, solution: PoseSolution
    ) -> None:
        """Keep an image to recover from, if it is better than the one before; asked of few images, which takes time."""
        due = image.stamp_ns - self._reference_ns >= REFERENCE_NS
        if due and not self._part.wanted(self._follower.reference, image.stamp_ns):
            self._reference_ns = image.stamp_ns
            later = self._recovery.motion.steady(image.stamp_ns + UNSEEN_NS).odom_T_cam
            self._follower.refer_to(images, tracks, solution.inlier & ~tracks.moving, solution.pose, later)

    def _add_to_reference(self) -> None:
        """Add points to the reference image: from far away most of those that were tracked are out of view."""
        reference = self._follower.reference
        if not reference.dense:
            most = REFERENCE_POINTS * self._config.max_features
            tracks = self._follower.renewed(reference)
            tracks = self._new_points.add(
                tracks, reference.images, reference.pose, np.zeros(6), most, moving_neighbours=1
            )
            reference.add(tracks.keep(~tracks.moving))
            self._follower.keep_only(self._tracks)

    def _lose(self, image: StereoImage, reason: str) -> tuple[Frame, None]:
        """Predict the pose; after some time with an open view start a new submap."""
        if self._readout is not None:
            self._readout.interrupt()
        bridge = self._bridge(image.stamp_ns)
        expected = self._expect(image.stamp_ns, bridge)
        self._follower.search_widely()
        dark = image.left.max() < DARK
        if self._loss.add(image.stamp_ns, self._stamp_ns, bridge is None or not dark, self._recovery.unobstructed):
            self._pose = expected.odom_T_cam
            self._velocity = self._recovery.motion.velocity_at(image.stamp_ns)
            self._solver.forget()
            self._movers.forget()
            self._bridging = bridge is not None
            self._submap_id += not self._bridging
            self._state, self._tracks = TrackState.INITIALIZING, Tracks()
            if not self._bridging:
                self._recovery.motion.forget()
        covered = not self._recovery.unobstructed and not dark
        state = TrackState.OCCLUDED if covered else TrackState.LOST
        state = state if bridge is None else TrackState.INERTIAL
        covariance = expected.covariance if bridge is None else bridge[1]
        return self._frame(image, expected.odom_T_cam, covariance, state, reason), None

    def _add_points(self, images: StereoPyramids) -> None:
        """Add new points after the tracked ones."""
        most = self._config.max_features
        self._tracks = self._new_points.add(self._tracks, images, self._pose, self._velocity, most)
        self._follower.keep_only(self._tracks)

    # -- messages --------------------------------------------------------------------------------------------------

    def _static_count(self) -> int:
        """Number of tracked points that are not on moving objects."""
        return int(np.count_nonzero(~self._tracks.moving))

    def _create_keyframe(self, image: StereoImage, images: StereoPyramids, covariance: F64, trusted: bool) -> Keyframe:
        """A keyframe of the image whose pose, with covariance (6, 6), has just been found."""
        keyframe = self._keyframes.create(
            image, self._pose, covariance, self._submap_id, self._rig_terms, self._sudden, self._sensors
        )
        self._keyframes.points = self._static_count()
        self._undescribed = keyframe, images, trusted
        return keyframe

    def _frame(
        self,
        image: StereoImage,
        odom_T_cam: F64,
        covariance: F64,
        state: TrackState,
        reason: str = "",
        inlier: Bool | None = None,
        keyframe: Keyframe | None = None,
        stats: dict[str, float] | None = None,
    ) -> Frame:
        """The message of a frame. Without `inlier` (N,) of the tracked points the pose is predicted, not observed."""
        tracks = self._tracks
        observations = Observations.empty()
        if inlier is not None:
            uv, uv_right = tracks.uv.copy(), tracks.uv_right.copy()
            observations = Observations(tracks.point_ids.copy(), uv, uv_right, tracks.age.copy(), inlier)
        reference_kf_id, kf_T_cam = self._keyframes.reference(odom_T_cam)
        return Frame(
            frame_id=image.frame_id,
            stamp_ns=image.stamp_ns,
            odom_T_cam=odom_T_cam.copy(),
            covariance=covariance.copy(),
            state=state,
            reason="dark" if reason and image.left.max() < DARK else reason,
            observations=observations,
            reference_kf_id=reference_kf_id,
            kf_T_cam=kf_T_cam,
            map_version=self._map_version,
            is_keyframe=keyframe is not None,
            stats=stats or {},
        )


def _stats(tracks: Tracks, solution: PoseSolution) -> dict[str, float]:
    """Statistics of a frame for plots."""
    return {
        "tracked": float(len(tracks)),
        "inliers": float(np.count_nonzero(solution.inlier & ~tracks.moving)),
        "moving": float(tracks.moving.mean()) if len(tracks) else 0.0,
        "right": float(np.count_nonzero(np.isfinite(tracks.uv_right[:, 0]))),
        "error": median(solution.error[solution.inlier]),
    }
