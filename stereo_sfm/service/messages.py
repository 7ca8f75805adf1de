"""Messages of the service to its outputs and callbacks. Wall clock is `unix_ns`, the sensor's clock `stamp_ns`."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import get_args

from stereo_sfm.calib.rig import Rig
from stereo_sfm.messages import Health
from stereo_sfm.types import F32, F64, I32, I64, U8, Bool, LiveDepth, Message, shape


class ServiceState(enum.StrEnum):
    """What the service is doing."""

    STARTING = "starting"
    RUNNING = "running"
    LOST = "lost"
    CAMERA_GONE = "camera_gone"
    DISK_FULL = "disk_full"
    STOPPING = "stopping"


@dataclass(frozen=True)
class Status:
    """The state of the service: sent when it changes, and every second."""

    state: ServiceState
    reason: str = ""  # a short sentence
    remedy: str = ""  # what a person can do
    since_ns: int = 0  # Unix time
    recording: str = "off"  # what is recorded now: "off", "full", "lean", "black_box"
    recording_problem: str = ""
    map_folder: str = ""
    map_saved_ns: int = 0  # Unix time; 0: not yet
    localized: bool = False  # poses are in the frame of the saved map
    map_is_new: bool = False  # the saved map begins with this session, and so has the frame of its poses
    session: int = 0  # pipelines started so far

    @property
    def in_saved_map(self) -> bool:
        """Whether the poses are in the frame of the saved map, and so its floor plan lies where it shows."""
        return self.localized or self.map_is_new


@dataclass(frozen=True, eq=False)
class Started(Message):
    """A pipeline is up, and its first pose follows; sent again in a session when the camera's tilt was measured."""

    session: int
    source: str
    rig: Rig
    live: bool


@dataclass(frozen=True, eq=False)
class PoseUpdate(Message):
    """The pose of the body at one image, also where tracking is lost."""

    frame_id: int
    stamp_ns: int  # mid-exposure
    unix_ns: int  # the same instant on this computer's wall clock
    captured_s: float  # monotonic clock when the driver had the image
    state: str  # name of a TrackState
    reason: str
    map_T_odom: F64 = field(metadata=shape(4, 4))
    odom_T_body: F64 = field(metadata=shape(4, 4))
    # (6, 6) of odom_T_body: position x y z, rotation about x y z of odom (as nav_msgs/Odometry has it)
    covariance: F64 = field(metadata=shape(6, 6))
    twist: F64  # (6,) body axes: linear m/s, angular rad/s; NaN where unknown
    twist_covariance: F64 = field(metadata=shape(6, 6))
    map_version: int
    session: int
    localized: bool
    tracked: bool  # the pose comes from this image
    down: F64  # (3,) gravity's direction in the map, zero: unknown

    @property
    def map_T_body(self) -> F64:
        """(4, 4) the pose in the map."""
        return self.map_T_odom @ self.odom_T_body


@dataclass(frozen=True, eq=False)
class MapCloud(Message):
    """The whole map, sent at most every few seconds."""

    stamp_ns: int
    version: int
    session: int
    saved: bool  # in the frame of the saved map
    point_ids: I64  # (P,) ascending
    points: F32 = field(metadata=shape(-1, 3))  # (P, 3) metres in the map
    kf_ids: I64  # (K,) ascending
    map_T_kf: F64 = field(metadata=shape(-1, 4, 4))


@dataclass(frozen=True, eq=False)
class PreviewImage(Message):
    """A camera image for display, with the tracks of the newest frame before it."""

    frame_id: int
    stamp_ns: int
    left: U8  # (H, W)
    right: U8 | None
    uv: F64 = field(metadata=shape(-1, 2))  # (N, 2) px in the left image
    age: I32  # (N,) frames
    inlier: Bool  # (N,)


@dataclass(frozen=True)
class HealthReport:
    """How the service keeps up, every second."""

    unix_ns: int
    stages: dict[str, Health]  # the newest of each
    rate_hz: float  # of frames
    latency_ms: tuple[float, float]  # from image to pose: 50th and 95th percentile
    dropped: dict[str, int]  # images since the start, by where: "sensor", "ring", "log"
    counters: dict[str, float]  # of the live camera
    disk_free: int  # bytes
    recording_bytes: int  # of all recordings
    rss: dict[str, int]  # resident bytes, by process
    restarts: int  # of the pipeline
    row_error_px: float  # systematic epipolar error; NaN: unknown


@dataclass(frozen=True)
class Event:
    """A line of the log: a loss, a restart, a saved map, a mark, a full disk."""

    unix_ns: int
    level: str  # a name of `logging`
    stage: str
    text: str


ServiceMessage = Started | Status | PoseUpdate | MapCloud | PreviewImage | HealthReport | Event | LiveDepth
EVERYTHING: frozenset[type[ServiceMessage]] = frozenset(get_args(ServiceMessage))  # for publishers that want all of it
