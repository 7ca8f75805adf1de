"""When a frame becomes a keyframe, and what the mapper and the loop closer get of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.order_statistics import median
from stereo_sfm.tracking.descriptors import describe
from stereo_sfm.tracking.flow.consensus import Movers, without_moving
from stereo_sfm.tracking.flow.klt import StereoPyramids
from stereo_sfm.tracking.flow.motion_prior import SPREAD
from stereo_sfm.tracking.flow.place_corners import SCALE, PlaceCorners
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.side_views import SideViews
from stereo_sfm.tracking.flow.sudden_turn import SuddenTurns
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.tracking.inertial.motion_sensors import MotionSensors
from stereo_sfm.types import F64, Corners, Keyframe, MotionLink, StereoImage

SPACING = 1.0 - 1.0 / SCALE, 0.1  # between described places: share of their distance (one level of scale), radians
FIRST = 4  # keyframes of a submap that are described in any case: by them it joins the others
CORRELATED_S = 5.0  # for which the error of gravity's direction stays about the same
# Odometry between keyframes: pixels err together, so that poses are less certain than their points say, and points that
# are no longer seen took their errors along: metres and radians, at least.
ODOMETRY_SIGMAS, MIN_ODOMETRY_SIGMAS = 2.0, (0.003, 0.002)


def without_points(image: StereoImage, kf_id: int, odom_T_cam: F64, **fields: Any) -> Keyframe:
    """A keyframe of an image, with further fields but without tracked points."""
    return Keyframe(
        kf_id=kf_id,
        frame_id=image.frame_id,
        stamp_ns=image.stamp_ns,
        odom_T_cam=odom_T_cam,
        point_ids=np.zeros(0, np.int64),
        uv_left=np.zeros((0, 2)),
        uv_right=np.zeros((0, 2)),
        points_cam=np.zeros((0, 3)),
        descriptors=np.zeros((0, 32), np.uint8),
        **fields,
    )


class Keyframes:
    """Creates keyframes, and knows the newest one, to which frames refer."""

    def __init__(
        self,
        config: TrackerConfig,
        shutter: RollingShutter,
        place_corners: PlaceCorners | None,
        side_views: SideViews | None,
        movers: Movers,
    ) -> None:
        self._config, self._shutter, self._movers = config, shutter, movers
        self._place_corners, self._side_views = place_corners, side_views
        self._described: tuple[Keyframe, float] | None = None  # newest with corners, their median distance in metres
        self._begun = -1, 0  # newest submap, and its first keyframe
        self.count = 0
        self.points = 0  # static points of the newest keyframe, with new ones
        self._pose: F64 = np.eye(4)  # odom_T_cam of the newest keyframe
        self._covariance: F64 = np.zeros((6, 6))  # of it
        self._frames_since = 0
        self._doubt: F64 = np.zeros(2)  # since the newest keyframe
        self._stamp_ns, self._submap_id = 0, -1  # of the newest keyframe
        self._turn: F64 = np.zeros(3)  # of the right camera, that the newest one was tracked with ...
        self._turned_kf_id = 0  # ... and the first one with it
        self._first_of_rig = 0  # id of the first keyframe of the current rig

    def use(self, rig: Rig) -> None:
        """Use a corrected rig: the next frame becomes a keyframe."""
        self._first_of_rig = self.count
        if self._place_corners is not None:
            self._place_corners.use(rig)
        if self._side_views is not None:
            self._side_views.use(rig)

    def count_frame(self, doubtful_s: float) -> None:
        """A frame was tracked since the newest keyframe.

        `doubtful_s`: seconds since the frame before, if most of what was followed contradicts the pose: it may be
        anybody's who moves, or a place that looks alike. Then the robot may have moved as robots do.
        """
        self._frames_since += 1
        self._doubt = self._doubt + np.square(SPREAD * doubtful_s)

    def due(self, tracks: Tracks) -> bool:
        """Whether the frame should become a keyframe: few of the newest one's static points are left, or the rig was
        corrected since."""
        config = self._config
        if self.count == self._first_of_rig:
            return True
        left = int(np.count_nonzero(~tracks.moving & (tracks.age >= self._frames_since)))
        return self._frames_since >= config.keyframe_max_frames or left < config.keyframe_share * self.points

    def resumed(self, kf_id: int) -> bool:
        """Whether a keyframe is one of the current rig."""
        return kf_id >= self._first_of_rig

    def reference(self, odom_T_cam: F64) -> tuple[int, F64]:
        """The newest keyframe's id (-1: none yet), and kf_T_cam (4, 4) of a pose (4, 4)."""
        return self.count - 1, se3.inverse(self._pose) @ odom_T_cam

    def create(
        self,
        image: StereoImage,
        odom_T_cam: F64,
        covariance: F64,
        submap_id: int,
        rig_terms: F64,
        sudden: SuddenTurns | None,
        sensors: MotionSensors | None = None,
    ) -> Keyframe:
        """A keyframe of an image, without points: see `describe`.

        Args:
            odom_T_cam: (4, 4), which the sensors have accepted. covariance: (6, 6) of it. rig_terms: (8,) current
                correction of the rig. sudden: rotation of the right camera besides.
        """
        keyframe = without_points(
            image,
            self.count,
            odom_T_cam.copy(),
            submap_id=submap_id,
            rig_terms=rig_terms.copy(),
            **({} if sudden is None else {"right_turn": sudden.turn, "right_turn_covariance": sudden.covariance}),
            odometry=self._moved(odom_T_cam, covariance) if submap_id == self._submap_id else None,
            doubt=self._doubt,
            readout_s=self._shutter.readout_s,
            **({} if sensors is None else self._measured(sensors, image.stamp_ns, odom_T_cam, submap_id)),
        )
        self._stamp_ns, self._submap_id = image.stamp_ns, submap_id
        if sudden is not None and not np.array_equal(sudden.turn, self._turn):
            self._turn, self._turned_kf_id = sudden.turn, keyframe.kf_id
        self.count, self._frames_since, self._doubt = self.count + 1, 0, np.zeros(2)
        self._pose, self._covariance = odom_T_cam.copy(), covariance.copy()
        return keyframe

    def shown(self, turn: F64, kf_id: int) -> int:
        """How many keyframes up to one were tracked with a turn (3,) of the right camera, if the newest one was."""
        return kf_id - self._turned_kf_id + 1 if np.array_equal(turn, self._turn) else 0

    def _moved(self, odom_T_cam: F64, covariance: F64) -> MotionLink:
        """The motion from the newest keyframe to a pose (4, 4) with covariance (6, 6)."""
        last_T_cam = se3.inverse(self._pose) @ odom_T_cam
        into = se3.adjoint(se3.inverse(last_T_cam))
        least = np.diag(np.repeat(np.square(MIN_ODOMETRY_SIGMAS), 3))
        return MotionLink(last_T_cam, ODOMETRY_SIGMAS**2 * (into @ self._covariance @ into.T + covariance) + least)

    def _measured(self, sensors: MotionSensors, stamp_ns: int, odom_T_cam: F64, submap_id: int) -> dict[str, Any]:
        """The fields of gravity and of what the sensors measured since the keyframe before.

        Gravity's error changes slowly: keyframes share what one time of correlation tells.
        """
        inertial, wheels = sensors.links(self._stamp_ns if submap_id == self._submap_id else stamp_ns, stamp_ns)
        fields: dict[str, Any] = {"inertial": inertial, "wheels": wheels, "samples": sensors.samples()}
        gravity = sensors.gravity(odom_T_cam)
        if gravity is not None and submap_id == self._submap_id:  # of a new submap the pose is not measured
            seconds = (stamp_ns - self._stamp_ns) * 1e-9
            fields["down"], fields["down_sigma"] = gravity[0], gravity[1] * np.sqrt(max(CORRELATED_S / seconds, 1.0))
        return fields

    def describe(self, keyframe: Keyframe, images: StereoPyramids, tracks: Tracks, velocity: F64) -> Keyframe:
        """The keyframe with its points, but those on moving objects, their descriptors and its corners.

        Args:
            tracks: its points. velocity: (6,) tangent a second.
        """
        corners, sides = self._corners(keyframe, images, tracks)
        static = tracks.keep(~tracks.moving)
        points_cam = se3.transform(se3.inverse(keyframe.odom_T_cam), static.points())
        uv_left, uv_right = self._shutter.at_stamp(static.uv, static.uv_right, points_cam, velocity)
        return replace(
            keyframe,
            point_ids=static.point_ids.copy(),
            uv_left=uv_left.copy(),
            uv_right=uv_right.copy(),
            points_cam=points_cam,
            descriptors=describe(images.left[0], static.uv),
            corners=self._shutter.corners_at_stamp(corners, velocity),
            sides=self._shutter.corners_at_stamp(sides, velocity),
        )

    def _corners(self, keyframe: Keyframe, images: StereoPyramids, tracks: Tracks) -> tuple[Corners, Corners]:
        """Static corners for place recognition: of the image, and of its side views; none near the last described."""
        corners = sides = Corners.none()
        if not self._place_due(keyframe):
            return corners, sides
        if self._place_corners is not None:
            corners = without_moving(self._place_corners.find_in(images.left, images.right), tracks, self._movers)
            distances = np.linalg.norm(corners.points_cam, axis=1).astype(np.float64)
            self._described = keyframe, median(distances) if len(distances) else 0.0
        if self._side_views is not None:
            sides = self._side_views.find(images.left, images.right, corners, keyframe.odom_T_cam, keyframe.submap_id)
            sides = without_moving(sides, tracks, self._movers)
        return corners, sides

    def _place_due(self, keyframe: Keyframe) -> bool:
        """Whether the view differs from the newest described one by more than place recognition bridges anyway."""
        if keyframe.submap_id != self._begun[0]:
            self._begun = keyframe.submap_id, keyframe.kf_id
        if self._described is None or keyframe.kf_id < self._begun[1] + FIRST:
            return True
        newest, distance = self._described
        metres, radians = se3.extent(se3.inverse(newest.odom_T_cam) @ keyframe.odom_T_cam)
        return bool(metres >= SPACING[0] * distance or radians >= SPACING[1])
