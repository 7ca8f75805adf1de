"""The table of topics: what is written, when, and whether `diff` compares it.

Foxglove schemas wherever one exists, so that Foxglove and rerun show them; `stereo_sfm.*` schemas are made from the
dataclasses of `stereo_sfm.types` (see `schema`). `log_time` is the sensor stamp, `publish_time` the wall clock,
`sequence` the frame id.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from stereo_sfm.log.samples import ImageInfo, ImuSample, WheelSample
from stereo_sfm.log.schema import full_name
from stereo_sfm.log.track_stats import TrackStats
from stereo_sfm.messages import Health, SourceCounters, StageTimes
from stereo_sfm.types import Applied, CalibrationUpdate, Dropped, Frame, Keyframe, LoopResult, MapUpdate, RowErrors

SCHEMA_VERSION = "1"

LEFT_IMAGE = "/cam0/image"
RIGHT_IMAGE = "/cam1/image"
THUMBNAIL = "/cam0/thumbnail"
DEPTH_IMAGE = "/depth/image"
LEFT_CALIBRATION = "/cam0/calibration"
RIGHT_CALIBRATION = "/cam1/calibration"
IMAGE_INFO = "/image_info"
IMU = "/imu"
WHEEL = "/wheel"
GROUND_TRUTH = "/ground_truth"
DROPPED = "/dropped"
APPLIED = "/applied"
TF = "/tf"
TF_STATIC = "/tf_static"
ODOMETRY = "/odom"
ODOM_POSE = "/odom/pose"
MAP_POSE = "/map/pose"
FRAME = "/frame"
STATS = "/stats"
FEATURES = "/cam0/features"
KEYFRAME = "/keyframe"
MAP_UPDATE = "/map/update"
CALIBRATION = "/calibration"
ROW_ERRORS = "/calibration/row_errors"
LOOP = "/loop"
POINTS = "/map/points"
TRAJECTORY = "/map/trajectory"
PATH = "/map/path"
SCENE = "/map/scene"
HEALTH = "/health"
STAGE_TIMES = "/stage_times"
COUNTERS = "/counters"
LOG = "/log"


@dataclass(frozen=True)
class Topic:
    """One row.

    Attributes:
        name: of the topic.
        message: the dataclass that it contains, or the protobuf name of Foxglove's message; "|" separates what an
            image topic may contain.
        when: when it is written.
        compare: whether `diff` compares it.
        sequence: the field of `message` that is the frame id.
    """

    name: str
    message: type[Any] | str
    when: str
    compare: bool = True
    sequence: str = "frame_id"

    @property
    def schema(self) -> str:
        """The protobuf names of its messages, separated by "|"."""
        return self.message if isinstance(self.message, str) else full_name(self.message)

    def key(self, message: object, now_ns: int) -> tuple[int, int]:
        """Log time and sequence of a message: its own stamp, or `now_ns` if it has none."""
        return getattr(message, "stamp_ns", now_ns), getattr(message, self.sequence)


_IMAGE = "foxglove.RawImage|foxglove.CompressedImage"

TABLE: tuple[Topic, ...] = (
    Topic(IMAGE_INFO, ImageInfo, "every image, before its pixels"),
    Topic(LEFT_IMAGE, _IMAGE, "every image"),
    Topic(RIGHT_IMAGE, _IMAGE, "every image of a stereo source"),
    Topic(THUMBNAIL, "foxglove.CompressedImage", "every few seconds of a recording: the left image, small"),
    Topic(DEPTH_IMAGE, "foxglove.RawImage", "every image of an RGB-D source, metres"),
    Topic(LEFT_CALIBRATION, "foxglove.CameraCalibration", "at the start and every second"),
    Topic(RIGHT_CALIBRATION, "foxglove.CameraCalibration", "at the start and every second"),
    Topic(IMU, ImuSample, "every sample"),
    Topic(WHEEL, WheelSample, "every sample"),
    Topic(GROUND_TRUTH, "foxglove.PoseInFrame", "every pose of the source's ground truth, in its own frame"),
    Topic(DROPPED, Dropped, "when frames are lost"),
    Topic(APPLIED, Applied, "when a map update is applied", sequence="before_frame_id"),
    Topic(TF, "foxglove.FrameTransforms", "every frame: map to odom, odom to body"),
    Topic(TF_STATIC, "foxglove.FrameTransforms", "at the start and every second: level, map, truth; body, cameras"),
    Topic(ODOMETRY, "foxglove.Odometry", "every frame, with covariance"),
    Topic(ODOM_POSE, "foxglove.PoseInFrame", "every frame, body in odom"),
    Topic(MAP_POSE, "foxglove.PoseInFrame", "every frame, body in map"),
    Topic(FRAME, Frame, "every frame: the tracker's result"),
    Topic(STATS, TrackStats, "every frame: flat numbers to plot"),
    Topic(FEATURES, "foxglove.ImageAnnotations", "every frame of a log with images: tracked points in the left one"),
    Topic(KEYFRAME, Keyframe, "every keyframe"),
    Topic(MAP_UPDATE, MapUpdate, "every keyframe: changed keyframes and points"),
    Topic(CALIBRATION, CalibrationUpdate, "when self-calibration corrects the rig, or reports a correction"),
    Topic(ROW_ERRORS, RowErrors, "every keyframe of a stereo camera: row errors by region, and their trend"),
    Topic(LOOP, LoopResult, "every keyframe: the loop closer's result, with reasons"),
    Topic(POINTS, "foxglove.PointCloud", "the whole map, at most every few seconds and at the end"),
    Topic(TRAJECTORY, "foxglove.PosesInFrame", "all keyframes, at most every second and at the end"),
    Topic(PATH, "foxglove.PointCloud", "the trajectory's positions, for viewers that draw no poses (rerun)"),
    Topic(SCENE, "foxglove.SceneUpdate", "loop and covisibility edges, with the trajectory"),
    Topic(HEALTH, Health, "every second and stage: rate, queue, latency (wall clock)", compare=False),
    Topic(STAGE_TIMES, StageTimes, "every frame: milliseconds in each stage (wall clock)", compare=False),
    Topic(COUNTERS, SourceCounters, "every few seconds: counters of a live camera", compare=False),
    Topic(LOG, "foxglove.Log", "human-readable text", compare=False),
)

BY_NAME: dict[str, Topic] = {topic.name: topic for topic in TABLE}
OF: dict[type[Any], Topic] = {topic.message: topic for topic in TABLE if isinstance(topic.message, type)}
