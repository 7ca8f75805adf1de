"""Image topics of ROS 2 as a live source; see `drivers.ros2.source`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Cameras, Driver
from stereo_sfm.drivers.options import SourceOptions, option
from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


@dataclass(frozen=True)
class Ros2Options(SourceOptions):
    """Options of `ros2:`."""

    left: str = option("", "topic of the left images, raw or compressed")
    right: str = option("", "topic of the right images; without it there is one camera")
    imu: str = option("", "topic of sensor_msgs/Imu, or those of gyroscope and accelerometer: GYRO,ACCEL")
    odom: str = option(
        "", "topic of nav_msgs/Odometry or geometry_msgs/TwistStamped: its velocities are the wheel odometry"
    )
    wait: float = option(10.0, "seconds to wait for topics, calibrations and images", low=0.1, high=3600)
    skew_ms: float = option(10.0, "largest difference between the stamps of a pair", low=0, high=1000)


def _open(place: str, options: Ros2Options) -> Source:
    from stereo_sfm.drivers.ros2.source import Ros2Source

    return Ros2Source(place or "stereo_sfm_source", options)


def _check(place: str, options: Ros2Options) -> None:
    if place and not place.isidentifier():
        raise StereoSfmError(
            f"ros2: '{place}' cannot be a node's name; topics are options: 'ros2:?left=TOPIC&right=TOPIC'"
        )


DRIVER = Driver("image topics of ROS 2, live", "NODE", Ros2Options, _open, _check, cameras=Cameras("camera of ROS 2"))
