"""The table of topics: what is written, when, and whether `diff` compares it.

Foxglove schemas wherever one exists, so that Foxglove and rerun show them. Messages of our own declare their topic and
the shapes of their arrays in their dataclass, from which their `stereo_sfm.*` schema is made (see `schema`).

`log_time` is the sensor stamp, `publish_time` the wall clock, `sequence` the frame id.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from stereo_sfm.log.samples import ImageInfo, ImuSample, WheelSample
from stereo_sfm.log.schema import full_name
from stereo_sfm.log.track_stats import TrackStats
from stereo_sfm.messages import Health, SourceCounters, StageTimes, Topic
from stereo_sfm.types import (
    Applied,
    CalibrationUpdate,
    Dropped,
    Frame,
    Keyframe,
    LoopResult,
    MapUpdate,
    RowErrors,
    SensorUpdate,
    StartCheck,
)

SCHEMA_VERSION = "1"

LEFT_IMAGE = "/cam0/image"
RIGHT_IMAGE = "/cam1/image"
THUMBNAIL = "/cam0/thumbnail"
DEPTH_IMAGE = "/depth/image"
LEFT_CALIBRATION = "/cam0/calibration"
RIGHT_CALIBRATION = "/cam1/calibration"
LIVE_DEPTH = "/depth"
LIVE_CALIBRATION = "/depth/calibration"
OBSTACLES = "/obstacles"
IMAGE_INFO = ImageInfo.TOPIC.name
IMU = ImuSample.TOPIC.name
WHEEL = WheelSample.TOPIC.name
GROUND_TRUTH = "/ground_truth"
DROPPED = Dropped.TOPIC.name
APPLIED = Applied.TOPIC.name
TF = "/tf"
TF_STATIC = "/tf_static"
ODOMETRY = "/odom"
ODOM_POSE = "/odom/pose"
MAP_POSE = "/map/pose"
FRAME = Frame.TOPIC.name
STATS = TrackStats.TOPIC.name
FEATURES = "/cam0/features"
KEYFRAME = Keyframe.TOPIC.name
MAP_UPDATE = MapUpdate.TOPIC.name
CALIBRATION = CalibrationUpdate.TOPIC.name
START_CHECK = StartCheck.TOPIC.name
ROW_ERRORS = RowErrors.TOPIC.name
SENSORS = SensorUpdate.TOPIC.name
LOOP = LoopResult.TOPIC.name
POINTS = "/map/points"
TRAJECTORY = "/map/trajectory"
PATH = "/map/path"
SCENE = "/map/scene"
HEALTH = Health.TOPIC.name
STAGE_TIMES = StageTimes.TOPIC.name
COUNTERS = SourceCounters.TOPIC.name
LOG = "/log"


@dataclass(frozen=True)
class Row:
    """One row.

    Attributes:
        topic: name, time of writing, comparison.
        message: the dataclass that it contains, or the protobuf name of Foxglove's message; "|" separates what an
            image topic may contain.
    """

    topic: Topic
    message: type[Any] | str

    @property
    def name(self) -> str:
        """Of the topic."""
        return self.topic.name

    @property
    def schema(self) -> str:
        """The protobuf names of its messages, separated by "|"."""
        return self.message if isinstance(self.message, str) else full_name(self.message)

    def key(self, message: object, now_ns: int) -> tuple[int, int]:
        """Log time and sequence of a message: its own stamp, or `now_ns` if it has none."""
        return getattr(message, "stamp_ns", now_ns), getattr(message, self.topic.sequence)


def _ours(message: type[Any]) -> Row:
    return Row(message.TOPIC, message)


def _foxglove(name: str, schemas: str, when: str, compare: bool = True) -> Row:
    return Row(Topic(name, when, compare), "|".join(f"foxglove.{schema}" for schema in schemas.split("|")))


_IMAGE = "RawImage|CompressedImage"

TABLE: tuple[Row, ...] = (
    _ours(ImageInfo),
    _foxglove(LEFT_IMAGE, _IMAGE, "every image"),
    _foxglove(RIGHT_IMAGE, _IMAGE, "every image of a stereo source"),
    _foxglove(THUMBNAIL, "CompressedImage", "every few seconds of a recording: the left image, small"),
    _foxglove(DEPTH_IMAGE, "RawImage", "every image of an RGB-D source, metres"),
    _foxglove(LIVE_DEPTH, "RawImage", "with dense.live: depth of a pair in millimetres, several times a second"),
    _foxglove(LIVE_CALIBRATION, "CameraCalibration", "with each of those: its pinhole camera"),
    _foxglove(OBSTACLES, "PointCloud", "with each of those: what stands in a robot's way, seen from the left camera"),
    _foxglove(LEFT_CALIBRATION, "CameraCalibration", "at the start and every second"),
    _foxglove(RIGHT_CALIBRATION, "CameraCalibration", "at the start and every second"),
    _ours(ImuSample),
    _ours(WheelSample),
    _foxglove(GROUND_TRUTH, "PoseInFrame", "every pose of the source's ground truth, in its own frame"),
    _ours(StartCheck),
    _ours(Dropped),
    _ours(Applied),
    _foxglove(TF, "FrameTransforms", "every frame: map to odom, odom to body; with an IMU level to map"),
    _foxglove(
        TF_STATIC,
        "FrameTransforms",
        "at the start and every second: level to map without an IMU; map, truth; body, cameras",
    ),
    _foxglove(ODOMETRY, "Odometry", "every frame, with covariance"),
    _foxglove(ODOM_POSE, "PoseInFrame", "every frame, body in odom"),
    _foxglove(MAP_POSE, "PoseInFrame", "every frame, body in map"),
    _ours(Frame),
    _ours(TrackStats),
    _foxglove(FEATURES, "ImageAnnotations", "every frame of a log with images: tracked points in the left one"),
    _ours(Keyframe),
    _ours(MapUpdate),
    _ours(CalibrationUpdate),
    _ours(RowErrors),
    _ours(SensorUpdate),
    _ours(LoopResult),
    _foxglove(POINTS, "PointCloud", "the whole map, at most every few seconds and at the end"),
    _foxglove(TRAJECTORY, "PosesInFrame", "all keyframes, at most every second and at the end"),
    _foxglove(PATH, "PointCloud", "the trajectory's positions, for viewers that draw no poses (rerun)"),
    _foxglove(SCENE, "SceneUpdate", "loop and covisibility edges, with the trajectory"),
    _ours(Health),
    _ours(StageTimes),
    _ours(SourceCounters),
    _foxglove(LOG, "Log", "human-readable text", compare=False),
)

BY_NAME: dict[str, Row] = {row.name: row for row in TABLE}
OF: dict[type[Any], Row] = {row.message: row for row in TABLE if isinstance(row.message, type)}
