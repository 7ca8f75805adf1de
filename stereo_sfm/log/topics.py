"""The one table of topics: what is written where, how often, and whether two runs are compared on it.

Foxglove schemas wherever one exists, so that Foxglove and rerun show them; `stereo_sfm.*` schemas are made from the
dataclasses of `stereo_sfm.types` (see `schema`). `log_time` is the sensor stamp, `publish_time` the wall clock,
`sequence` the frame id.
"""

from __future__ import annotations

from dataclasses import dataclass

SCHEMA_VERSION = "1"

LEFT_IMAGE = "/cam0/image"
RIGHT_IMAGE = "/cam1/image"
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
    """One row: name, schema, when it is written, whether `diff` compares it."""

    name: str
    schema: str  # protobuf full name; "|" separates what an image topic may hold
    when: str
    compare: bool = True


_IMAGE = "foxglove.RawImage|foxglove.CompressedImage"

TABLE: tuple[Topic, ...] = (
    Topic(IMAGE_INFO, "stereo_sfm.ImageInfo", "every image, before its pixels"),
    Topic(LEFT_IMAGE, _IMAGE, "every image"),
    Topic(RIGHT_IMAGE, _IMAGE, "every image of a stereo source"),
    Topic(DEPTH_IMAGE, "foxglove.RawImage", "every image of an RGB-D source, metres"),
    Topic(LEFT_CALIBRATION, "foxglove.CameraCalibration", "at the start and every second"),
    Topic(RIGHT_CALIBRATION, "foxglove.CameraCalibration", "at the start and every second"),
    Topic(IMU, "stereo_sfm.ImuSample", "every sample"),
    Topic(WHEEL, "stereo_sfm.WheelSample", "every sample"),
    Topic(GROUND_TRUTH, "foxglove.PoseInFrame", "every pose of the source's ground truth, in its own frame"),
    Topic(DROPPED, "stereo_sfm.Dropped", "when frames are lost"),
    Topic(APPLIED, "stereo_sfm.Applied", "when a map update is applied"),
    Topic(TF, "foxglove.FrameTransforms", "every frame: map to odom, odom to body"),
    Topic(TF_STATIC, "foxglove.FrameTransforms", "at the start and every second: level, map, truth; body, eyes"),
    Topic(ODOMETRY, "foxglove.Odometry", "every frame, with covariance"),
    Topic(ODOM_POSE, "foxglove.PoseInFrame", "every frame, body in odom"),
    Topic(MAP_POSE, "foxglove.PoseInFrame", "every frame, body in map"),
    Topic(FRAME, "stereo_sfm.Frame", "every frame: the tracker's whole answer"),
    Topic(STATS, "stereo_sfm.TrackStats", "every frame: flat numbers to plot"),
    Topic(FEATURES, "foxglove.ImageAnnotations", "every frame of a log with images: tracked points in the left one"),
    Topic(KEYFRAME, "stereo_sfm.Keyframe", "every keyframe"),
    Topic(MAP_UPDATE, "stereo_sfm.MapUpdate", "every keyframe: the mapper's answer"),
    Topic(LOOP, "stereo_sfm.LoopResult", "every keyframe: the loop closer's answer, with reasons"),
    Topic(POINTS, "foxglove.PointCloud", "the whole map, at most every few seconds and at the end"),
    Topic(TRAJECTORY, "foxglove.PosesInFrame", "all keyframes, at most every second and at the end"),
    Topic(PATH, "foxglove.PointCloud", "the trajectory's positions, for players that draw no poses (rerun)"),
    Topic(SCENE, "foxglove.SceneUpdate", "loop and covisibility edges, with the trajectory"),
    Topic(HEALTH, "stereo_sfm.Health", "every second and stage: rate, queue, latency (wall clock)", compare=False),
    Topic(STAGE_TIMES, "stereo_sfm.StageTimes", "every frame: milliseconds in each stage (wall clock)", compare=False),
    Topic(COUNTERS, "stereo_sfm.SourceCounters", "every few seconds: what a live camera counts", compare=False),
    Topic(LOG, "foxglove.Log", "text for people", compare=False),
)

BY_NAME: dict[str, Topic] = {topic.name: topic for topic in TABLE}
