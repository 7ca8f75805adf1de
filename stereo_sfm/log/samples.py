"""Messages of a log that belong to an image besides its pixels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from stereo_sfm.messages import Topic
from stereo_sfm.types import F64


@dataclass(frozen=True)
class ImageInfo:
    """What belongs to an image besides its pixels; tells the reader which messages make the frame whole."""

    TOPIC: ClassVar[Topic] = Topic("/image_info", "every image, before its pixels")

    frame_id: int
    stamp_ns: int
    right_stamp_ns: int
    exposure_us: float
    gain: float
    dropped_before: int
    has_right: bool
    has_depth: bool
    imu_count: int  # -1: the source has no inertial unit
    wheel_count: int  # -1: no wheel odometry


@dataclass(frozen=True)
class ImuSample:
    """One inertial sample in the unit's own axes, NaN for what was not sampled."""

    TOPIC: ClassVar[Topic] = Topic("/imu", "every sample")

    stamp_ns: int
    gyro_x: float  # rad/s
    gyro_y: float
    gyro_z: float
    accel_x: float  # m/s^2
    accel_y: float
    accel_z: float


@dataclass(frozen=True)
class WheelSample:
    """One wheel odometry sample, wheel axes; NaN velocities where only the wheels' speeds are known."""

    TOPIC: ClassVar[Topic] = Topic("/wheel", "every sample")

    stamp_ns: int
    linear_x: float  # m/s
    linear_y: float
    linear_z: float
    angular_x: float  # rad/s
    angular_y: float
    angular_z: float
    speeds: F64 = field(default_factory=lambda: np.zeros(0))  # (W,) rad/s of each wheel
