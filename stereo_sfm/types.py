"""Everything that flows between the stages: frozen dataclasses of numpy arrays, read-only after construction.

Frames and units: ``a_T_b`` is (4, 4) float64 with ``p_a = a_T_b @ p_b``; metres, radians, integer nanoseconds of the
sensor's clock. Frame names: ``map`` (may jump) -> ``odom`` (continuous) -> ``cam`` (left optical: x right, y down,
z forward). Pixel (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stereo_sfm.messages import Topic

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
Bool = NDArray[np.bool_]


RIG_TERMS = 8  # of `CalibrationUpdate`
LEFT_OUT = 1000  # images at most, the last ones, whose samples come with the next one where a stage is too slow
FAILED = "error: "  # begins the reason of a `LoopResult` where the loop closer failed


def shape(*axes: int) -> dict[str, tuple[int, ...]]:
    """Metadata of an array field with more than one axis, so that its shape can be restored from a log.

    Args:
        axes: of the array; -1 in front stands for the number of rows.
    """
    return {"shape": axes}


def no_ids(*axes: int) -> I64:
    """An empty array of ids, (0,) or of the given shape."""
    return np.zeros(axes or (0,), np.int64)


class ReadOnly:
    """Base of what has read-only arrays."""

    def __post_init__(self) -> None:
        self._freeze()

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Arrays stay read-only on the way through a pipe: compiled kernels see the same types in every process."""
        self.__dict__.update(state)
        self._freeze()

    def _freeze(self) -> None:
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False


class Message(ReadOnly):
    """Base of everything that flows."""


class TrackState(enum.IntEnum):
    """What the tracker knows about a frame's pose."""

    INITIALIZING = 0  # no pose yet (monocular start, first black frames)
    OK = 1  # pose from enough inliers
    RECOVERED = 2  # first good pose after LOST frames, in the same odometry frame, or one that corrects it
    LOST = 3  # pose predicted only; `Frame.reason` says why
    RESTARTED = 4  # tracking began again as a new submap at the predicted pose
    INERTIAL = 5  # the images show nothing: pose from IMU or wheels since the last good one, with its covariance
    OCCLUDED = 6  # as LOST, while something before the camera covers what it knows


@dataclass(frozen=True, eq=False)
class ImuSamples(Message):
    """Inertial samples since the previous frame, in the IMU's own axes."""

    stamp_ns: I64  # (N,) ascending, the camera's clock
    gyro: F64 = field(metadata=shape(-1, 3))  # (N, 3) rad/s, NaN rows where only the accelerometer was sampled
    accel: F64 = field(metadata=shape(-1, 3))  # (N, 3) m/s^2, NaN rows where only the gyroscope was sampled

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def part(self, rows: slice | I64) -> ImuSamples:
        """Some of the samples."""
        return ImuSamples(self.stamp_ns[rows], self.gyro[rows], self.accel[rows])

    def shifted(self, shift_ns: int) -> ImuSamples:
        """The same samples at later times."""
        return ImuSamples(self.stamp_ns + shift_ns, self.gyro, self.accel)

    @staticmethod
    def joined(parts: Sequence[ImuSamples]) -> ImuSamples:
        """One after the other."""
        stamps, gyro, accel = zip(*((p.stamp_ns, p.gyro, p.accel) for p in parts), strict=True)
        return ImuSamples(np.concatenate(stamps), np.concatenate(gyro), np.concatenate(accel))


@dataclass(frozen=True, eq=False)
class WheelSamples(Message):
    """Wheel odometry since the previous frame: velocities of the robot (x forward, y left), or speeds of its wheels."""

    stamp_ns: I64  # (N,) ascending, the camera's clock
    linear: F64 = field(metadata=shape(-1, 3))  # (N, 3) m/s, NaN rows where only the wheels' speeds are known
    angular: F64 = field(metadata=shape(-1, 3))  # (N, 3) rad/s, likewise
    speeds: F64 = field(default_factory=lambda: np.zeros((0, 0)))  # (N, W) rad/s of each wheel; (0, 0): unknown

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def part(self, rows: slice | I64) -> WheelSamples:
        """Some of the samples."""
        speeds = self.speeds[rows] if len(self.speeds) else self.speeds
        return WheelSamples(self.stamp_ns[rows], self.linear[rows], self.angular[rows], speeds)

    def shifted(self, shift_ns: int) -> WheelSamples:
        """The same samples at later times."""
        return WheelSamples(self.stamp_ns + shift_ns, self.linear, self.angular, self.speeds)

    @staticmethod
    def of_wheels(stamp_ns: I64, speeds: F64) -> WheelSamples:
        """Samples of (N, W) rad/s of each wheel."""
        unknown = np.full((len(stamp_ns), 3), np.nan)
        return WheelSamples(stamp_ns, unknown, unknown.copy(), speeds)

    @staticmethod
    def joined(parts: Sequence[WheelSamples]) -> WheelSamples:
        """One after the other."""
        parts = [p for p in parts if len(p)] or list(parts[:1])
        return WheelSamples(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(WheelSamples)))


@dataclass(frozen=True, eq=False)
class StereoImage(Message):
    """One synchronised pair (or a single image, or an image with depth), as a driver yields it."""

    frame_id: int  # number of the image in its source, growing
    stamp_ns: int  # sensor clock, mid-exposure, left camera
    left: U8  # (H, W)
    right: U8 | None = None  # (H, W); None for monocular and RGB-D sources
    depth: F32 | None = None  # (H, W) metres along the left optical axis, NaN where unknown (RGB-D sources)
    right_stamp_ns: int = 0  # 0: same as left
    exposure_us: float = float("nan")  # microseconds, NaN where unknown
    gain: float = float("nan")  # of the sensor, NaN where unknown
    dropped_before: int = 0  # frames the sensor or the driver lost just before this one
    imu: ImuSamples | None = None  # since the image before
    wheel: WheelSamples | None = None  # since the image before

    def without_pixels(self) -> StereoImage:
        """What is kept of an image that is left out."""
        return replace(self, left=np.zeros((0, 0), np.uint8), right=None, depth=None)

    def following(self, left_out: Sequence[StereoImage], lost: int = 0) -> StereoImage:
        """The image with the samples of the images before it that are left out, so that none is missing.

        Args:
            lost: how many more images it says were dropped before it.
        """
        if not left_out:
            return self
        imu = [image.imu for image in (*left_out, self) if image.imu is not None]
        wheel = [image.wheel for image in (*left_out, self) if image.wheel is not None]
        return replace(
            self,
            dropped_before=self.dropped_before + lost,
            imu=ImuSamples.joined(imu) if imu else None,
            wheel=WheelSamples.joined(wheel) if wheel else None,
        )


@dataclass(frozen=True, eq=False)
class LiveDepth(Message):
    """Depth of one pair, and what stands in a robot's way, both seen from the left camera."""

    frame_id: int
    stamp_ns: int
    depth_mm: U16  # (H, W) along the optical axis of a pinhole camera with the axes of the left one; 0: unknown
    pinhole: F64  # (4,) px: fx, fy, cx, cy of that camera
    obstacles: F32 = field(metadata=shape(-1, 3))  # (N, 3) metres in the left camera

    def points(self, step: int) -> F64:
        """(N, 3) metres in the left camera: what every `step`-th pixel shows, the floor, too."""
        depth = self.depth_mm[::step, ::step]
        row, column = np.nonzero(depth)
        z = depth[row, column] / 1000.0
        fx, fy, cx, cy = self.pinhole.tolist()
        return np.stack([(step * column - cx) / fx * z, (step * row - cy) / fy * z, z], axis=1)


@dataclass(frozen=True, eq=False)
class Observations(Message):
    """Points seen in one frame, one row each."""

    point_ids: I64  # (N,) the same id is the same physical point in every frame of this run
    uv_left: F64 = field(metadata=shape(-1, 2))  # (N, 2) px
    uv_right: F64 = field(metadata=shape(-1, 2))  # (N, 2) px, NaN where the right camera does not see it
    age: I32  # (N,) frames since the track began
    inlier: Bool  # (N,) used in the pose

    @staticmethod
    def empty() -> Observations:
        return Observations(
            np.zeros(0, np.int64),
            np.zeros((0, 2)),
            np.zeros((0, 2)),
            np.zeros(0, np.int32),
            np.zeros(0, bool),
        )

    def __len__(self) -> int:
        return len(self.point_ids)


@dataclass(frozen=True, eq=False)
class Frame(Message):
    """The tracker's result for one image."""

    TOPIC: ClassVar[Topic] = Topic("/frame", "every frame: the tracker's result")

    frame_id: int  # of its image
    stamp_ns: int  # of its image: sensor clock, mid-exposure, left camera
    odom_T_cam: F64 = field(metadata=shape(4, 4))  # (4, 4) continuous odometry pose, metres
    # (6, 6) of the pose, in the camera's axes: translation along x, y, z (m²), then rotation about x, y, z (rad²):
    # that of xi = (rho, phi) in odom_T_cam @ exp(xi)
    covariance: F64 = field(metadata=shape(6, 6))
    state: TrackState  # what is known about the pose
    # "" where the pose is good, else why not, a short stable word: "dark", "too_few_points", "no_consensus",
    # "not_found", "first_image"; the estimators of --odometry have others ("low_parallax", "ill_conditioned", ...)
    reason: str
    observations: Observations  # the points seen; empty where the pose is only predicted
    reference_kf_id: int  # keyframe that the frame moves with in the map, -1 before the first
    kf_T_cam: F64 = field(metadata=shape(4, 4))  # (4, 4) pose in the reference keyframe, for the final trajectory
    map_version: int = 0  # last MapUpdate applied before this frame
    is_keyframe: bool = False  # whether it enters the map
    # numbers worth plotting, no wall clock, none where the pose is predicted: `tracked` points, `inliers` (in the
    # pose), `right` (seen by both cameras), `moving` (share of the points on things that move), `error` (median
    # residual of the inliers in standard deviations); with an IMU `roll_deg`, `pitch_deg` and the standard deviation
    # of each, `tilt_sigma_deg`; other trackers: `features`, `matches`, `line_share`, `parallax_deg`, ...
    stats: dict[str, float] = field(default_factory=dict[str, float])


@dataclass(frozen=True, eq=False)
class Corners(Message):
    """Corners that a detector finds again when the place is revisited: a keyframe is recognised by them."""

    uv_left: F32 = field(metadata=shape(-1, 2))  # (N, 2) px
    uv_right: F32 = field(metadata=shape(-1, 2))  # (N, 2) px
    points_cam: F32 = field(metadata=shape(-1, 3))  # (N, 3) metres in the keyframe's camera
    descriptors: U8 = field(metadata=shape(-1, 32))  # (N, 32) binary (oriented BRIEF)

    @staticmethod
    def none() -> Corners:
        uv, xyz = np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32)
        return Corners(uv, uv.copy(), xyz, np.zeros((0, 32), np.uint8))

    @staticmethod
    def joined(parts: Sequence[Corners]) -> Corners:
        """One after the other."""
        parts = [Corners.none(), *parts]
        return Corners(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Corners)))

    def __len__(self) -> int:
        return len(self.uv_left)


@dataclass(frozen=True, eq=False)
class InertialLink(Message):
    """What the IMU measured since the keyframe before, and what the tracker knows of its state at this one."""

    stamp_ns: I64  # (N + 1,) edges of the N intervals, from the stamp of the keyframe before to this one's; or none
    gyro: F64 = field(metadata=shape(-1, 3))  # (N, 3) rad/s in each, corrected by the calibration
    accel: F64 = field(metadata=shape(-1, 3))  # (N, 3) m/s^2, likewise
    state: F64  # (12,) velocity, gravity (m/s^2, downwards), biases of accelerometer and gyroscope: the IMU's axes
    covariance: F64 = field(metadata=shape(12, 12))  # (12, 12) of it; zero while it is not known


@dataclass(frozen=True, eq=False)
class MotionLink(Message):
    """The motion since the keyframe before, by the wheels or by the images between."""

    last_T_cam: F64 = field(metadata=shape(4, 4))  # (4, 4) motion of the left camera
    covariance: F64 = field(metadata=shape(6, 6))  # (6, 6) of last_T_cam @ exp(xi), xi = (rho, phi)


@dataclass(frozen=True, eq=False)
class SensorSamples(Message):
    """What calibrates IMU and wheels: poses that the images gave since the keyframe before, and the samples."""

    stamp_ns: I64  # (N,) of the images
    odom_T_cam: F64 = field(metadata=shape(-1, 4, 4))  # (N, 4, 4) without the sensors' corrections
    imu: ImuSamples | None  # uncorrected
    wheel: WheelSamples | None  # likewise


@dataclass(frozen=True, eq=False)
class Keyframe(Message):
    """A frame that enters the map, with what place recognition and mapping need."""

    TOPIC: ClassVar[Topic] = Topic("/keyframe", "every keyframe")

    kf_id: int  # 0, 1, 2, ... in this run
    frame_id: int  # of its frame
    stamp_ns: int  # of its frame
    odom_T_cam: F64 = field(metadata=shape(4, 4))  # (4, 4) at creation
    point_ids: I64  # (N,) tracks' ids: the same id is the same physical point in every keyframe of this run
    # px; with a rolling shutter where they would be if all rows were exposed at the stamp
    uv_left: F64 = field(metadata=shape(-1, 2))
    uv_right: F64 = field(metadata=shape(-1, 2))  # the same, NaN where unseen
    points_cam: F64 = field(metadata=shape(-1, 3))  # metres in this keyframe's camera, NaN where the depth is unknown
    descriptors: U8 = field(metadata=shape(-1, 32))  # binary (oriented BRIEF), zero rows where none could be computed
    submap_id: int = 0  # grows when tracking restarts after it was lost
    corners: Corners = field(default_factory=Corners.none)  # for place recognition
    rig_terms: F64 = field(default_factory=lambda: np.zeros(RIG_TERMS))  # (8,) as in `CalibrationUpdate`
    sides: Corners = field(default_factory=Corners.none)  # described in views that face the shelves on both sides
    down: F64 = field(default_factory=lambda: np.zeros(3))  # (3,) gravity's direction in this camera, zero: unknown
    down_sigma: float = 0.0  # radians, its standard deviation about each horizontal axis; 0: unknown
    inertial: InertialLink | None = None  # None: no IMU, or one that is left out
    wheels: MotionLink | None = None  # None: no wheels, samples are missing, or no keyframe before in this submap
    odometry: MotionLink | None = None  # by the images; None: no keyframe before in this submap
    doubt: F64 = field(default_factory=lambda: np.zeros(2))  # (2,) m^2, rad^2: see `Keyframes.count_frame`
    right_turn: F64 = field(default_factory=lambda: np.zeros(3))  # (3,) rad, of the right camera besides `rig_terms`
    right_turn_covariance: F64 = field(default_factory=lambda: np.zeros((3, 3)), metadata=shape(3, 3))  # of it
    readout_s: float = 0.0  # of the rows of its image, with which it was tracked
    samples: SensorSamples | None = None  # where the sensors are calibrated

    @property
    def described(self) -> bool:
        """Whether it has corners, by which its place can be recognised."""
        return len(self.corners) + len(self.sides) > 0


@dataclass(frozen=True, eq=False)
class CalibrationUpdate(Message):
    """The rig's terms that the mapper found: rotation of the right camera about x, y, z (3, radians), direction of the
    baseline along y and z (2, radians), logarithm of the right focal length against the left, decentering of the right
    lens against the left along x and y (2, radians)."""

    TOPIC: ClassVar[Topic] = Topic("/calibration", "when self-calibration corrects the rig, or reports a correction")

    version: int  # of the map update that brings it
    kf_id: int
    stamp_ns: int
    terms: F64  # (8,) added to the rig as its calibration says
    terms_covariance: F64  # (8, 8)
    since_kf_id: int  # first keyframe that was seen by the rig so corrected; those before stay, or drift towards it
    applied: bool  # False: only reported
    why: str  # "significant", "step", "refined", "drift", or "kept" from the session before
    text: str  # human-readable

    def __post_init__(self) -> None:
        """Restore the covariance's shape; logs from before the decentering was a term have six, the others were 0."""
        known = len(self.terms)
        terms, covariance = np.zeros(RIG_TERMS), np.zeros((RIG_TERMS, RIG_TERMS))
        terms[:known], covariance[:known, :known] = self.terms, self.terms_covariance.reshape(known, known)
        object.__setattr__(self, "terms", terms)
        object.__setattr__(self, "terms_covariance", covariance)
        super().__post_init__()


@dataclass(frozen=True)
class StartCheck:
    """What the first images said about the calibration before the run began; there is none where they fit it."""

    TOPIC: ClassVar[Topic] = Topic("/start_check", "before the first frame, if the images contradict the calibration")

    frame_id: int  # the first image
    stamp_ns: int
    text: str  # what is wrong
    remedy: str  # what is done about it, or can be; "" where the text says it
    shown: bool  # by the images; False: only a guess, for a tracker that does not start
    rig: str  # the two cameras that the run uses instead, as the text of a rig.yaml; "": the given ones
    right_shift: int  # left image k is used with right image k + right_shift

    @property
    def line(self) -> str:
        """One human-readable line."""
        return f"{self.text}: {self.remedy}" if self.remedy else self.text


@dataclass(frozen=True, eq=False)
class SensorUpdate(Message):
    """The terms that the mapper found of the calibration of IMU and wheels; of a sensor without evidence they are 0."""

    TOPIC: ClassVar[Topic] = Topic(
        "/calibration/sensors", "when the calibration of IMU or wheels is corrected, or confirmed"
    )

    version: int  # of the map update that brings it
    kf_id: int
    stamp_ns: int
    imu: F64  # (4,) rotation about the IMU's axes (3, radians), seconds of time offset, added to the calibration
    imu_sigma: F64  # (4,) standard deviations; infinite while it is not known
    # (8,) scale, difference of the sides, turns (shares), direction, pitch (radians), time offset (seconds), position
    # ahead and to the left (metres)
    wheel: F64
    wheel_sigma: F64  # (8,) likewise
    text: str  # human-readable


@dataclass(frozen=True, eq=False)
class RowErrors(Message):
    """How well the rig fits what is seen, after a keyframe; averages over the last ones."""

    TOPIC: ClassVar[Topic] = Topic(
        "/calibration/row_errors", "every keyframe of a stereo camera: row errors by region, and their trend"
    )

    kf_id: int
    stamp_ns: int
    region_px: F64  # (12,) signed distance from the epipolar curve by region, 3 rows of 4; NaN where nothing was seen
    systematic_px: float  # root mean square over the regions
    trend_px: float  # how much that has grown of late
    warning: bool  # matches will be lost if it goes on


@dataclass(frozen=True, eq=False)
class MapUpdate(Message):
    """The mapper's result for one keyframe (exactly one each, possibly empty)."""

    TOPIC: ClassVar[Topic] = Topic("/map/update", "every keyframe: changed keyframes and points")

    version: int  # 1, 2, 3, ...
    kf_id: int  # the keyframe whose result it is
    kf_ids: I64  # (K,) living keyframes that are new or moved
    map_T_kf: F64 = field(metadata=shape(-1, 4, 4))  # (K, 4, 4) their new poses
    point_ids: I64 = field(default_factory=no_ids)  # (P,) new or moved points, in track ids
    # (P, 3) their positions, metres in the map
    points_map: F64 = field(default_factory=lambda: np.zeros((0, 3)), metadata=shape(-1, 3))
    culled_point_ids: I64 = field(default_factory=no_ids)  # (C,) points removed from the map
    # (D, 2) old id -> id that replaces it
    fused_point_ids: I64 = field(default_factory=lambda: no_ids(0, 2), metadata=shape(-1, 2))
    # (4, 4) takes poses of the odometry into the map, from now on
    map_T_odom: F64 = field(default_factory=lambda: np.eye(4), metadata=shape(4, 4))
    culled_kf_ids: I64 = field(default_factory=no_ids)  # (R,) keyframes removed from the map
    carrier_kf_ids: I64 = field(default_factory=no_ids)  # (R,) the keyframe that each moves with from now on
    # (R, 4, 4) their poses relative to those
    carrier_T_kf: F64 = field(default_factory=lambda: np.zeros((0, 4, 4)), metadata=shape(-1, 4, 4))
    refused_kf_ids: I64 = field(default_factory=no_ids)  # (L,) whose accepted loop the mapper rejected
    calibration: CalibrationUpdate | None = None  # the rig from this update on, where that changes
    row_errors: RowErrors | None = None  # only with two cameras
    sensors: SensorUpdate | None = None  # the calibration of IMU and wheels from this update on, where that changes
    down: F64 = field(default_factory=lambda: np.zeros(3))  # (3,) gravity's direction in the map, zero: unknown


@dataclass(frozen=True, eq=False)
class LoopResult(Message):
    """The loop closer's result for one keyframe (exactly one each)."""

    TOPIC: ClassVar[Topic] = Topic("/loop", "every keyframe: the loop closer's result, with reasons")

    kf_id: int  # the keyframe whose result it is
    candidate_kf_id: int  # -1: no loop
    candidate_T_kf: F64 = field(metadata=shape(4, 4))  # (4, 4) identity when rejected
    information: F64 = field(metadata=shape(6, 6))  # (6, 6) inverse covariance of candidate_T_kf @ exp(xi)
    # (M, 2) point ids (candidate's, this keyframe's) that are one physical point
    matches: I64 = field(metadata=shape(-1, 2))
    inliers: int  # corners of the keyframe that agree
    score: float  # similarity of the bags of words, from 0 to 1
    # "" when accepted, else why the best candidate was rejected ("no_candidate", "too_few_inliers", ...), or the error
    reason: str
    rejected: tuple[tuple[int, float, str], ...] = ()  # every rejected candidate: (kf_id, score, reason)
    # (S, 3) corners of side views that the loop matched: number of the corner, keyframe, row in its `sides`
    sightings: I64 = field(default_factory=lambda: no_ids(0, 3), metadata=shape(-1, 3))
    forgotten_kf_ids: I64 = field(default_factory=no_ids)  # (F,) that no later result names

    @property
    def failed(self) -> bool:
        """Whether the loop closer failed at this keyframe."""
        return self.reason.startswith(FAILED)

    @staticmethod
    def without_loop(
        kf_id: int, reason: str, score: float = 0.0, rejected: tuple[tuple[int, float, str], ...] = ()
    ) -> LoopResult:
        """The result for a keyframe that closes no loop."""
        return LoopResult(kf_id, -1, np.eye(4), np.zeros((6, 6)), no_ids(0, 2), 0, score, reason, rejected)


@dataclass(frozen=True)
class Dropped:
    """A frame that never reached a stage."""

    TOPIC: ClassVar[Topic] = Topic("/dropped", "when frames are lost")

    frame_id: int
    stamp_ns: int
    where: str  # "sensor", "ring" (capture), "log" (tracked, but not logged)
    why: str
    count: int = 1


@dataclass(frozen=True)
class Applied:
    """Which map update was applied just before which frame (the recorded schedule of a realtime run)."""

    TOPIC: ClassVar[Topic] = Topic("/applied", "when a map update is applied", sequence="before_frame_id")

    version: int
    before_frame_id: int
    stamp_ns: int = 0  # of that frame


@dataclass(frozen=True, eq=False)
class Trajectory(Message):
    """Poses over time."""

    stamp_ns: I64  # (N,) ascending
    poses: F64  # (N, 4, 4) world_T_cam, or world_T_body where the name says so
    oriented: bool = True  # False: only the positions are known, the rotations mean nothing

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def positions(self) -> F64:
        """(N, 3) metres."""
        return self.poses[:, :3, 3]

    @property
    def length(self) -> float:
        """Path length in metres."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())
