"""The sections of robot.toml about outputs, the operator's page and who may connect."""

from __future__ import annotations

from dataclasses import dataclass, field

from stereo_sfm.settings import line, number, path, switch, word

# Foxglove's own application in a browser, under both of its names, and on the desktop
FOXGLOVE_ORIGINS = "https://app.foxglove.dev https://studio.foxglove.dev file://"


@dataclass(frozen=True)
class PoseSocketConfig:
    """Poses for other programs, one message each, on a socket."""

    enabled: bool = switch(False, "Send poses on a socket")
    address: str = path("tcp://ADDRESS:PORT, or the path of a local socket", "tcp://127.0.0.1:7000")
    format: str = word("json", ("json", "protobuf"), "Lines of JSON, or protobuf messages with their length before")


@dataclass(frozen=True)
class FoxgloveConfig:
    """The topics of the log, live, for Foxglove and whatever speaks its WebSocket protocol."""

    enabled: bool = switch(False, "Serve Foxglove")
    address: str = line("127.0.0.1", "Address to listen on")
    port: int = number(8765, 1, 65535, "Port to listen on")
    picture_hz: float = number(5.0, 0, 60, "Images a second")
    origins: str = line(FOXGLOVE_ORIGINS, "Web applications that may connect, by the origin that a browser sends")


@dataclass(frozen=True)
class Ros2Config:
    """Odometry, transforms, map and services for ROS 2."""

    enabled: bool = switch(False, "Publish to ROS 2 (needs rclpy)")
    namespace: str = line("", "Namespace of the node, its topics and services")
    map_frame: str = line("map", "Name of the map's frame")
    odom_frame: str = line("odom", "Name of the odometry's frame")
    base_frame: str = line("base_link", "Name of the robot's frame")
    tf: bool = switch(True, "Publish the transforms from map to odom and from odom to the robot")
    use_sim_time: bool = switch(False, "Stamp messages by the camera's clock, as of a simulator or a played bag")


@dataclass(frozen=True)
class PageConfig:
    """The operator's page."""

    enabled: bool = switch(False, "Serve the page")
    address: str = line("127.0.0.1", "Address to listen on")
    port: int = number(8080, 1, 65535, "Port to listen on")
    picture_hz: float = number(4.0, 0, 30, "Images a second")
    surface: str = path("Folder of `dense` for the saved map, whose picture from above lies under the map")


@dataclass(frozen=True)
class SecurityConfig:
    """Who may connect."""

    token_file: str = path("File with the token; empty: one is made that only this user can read")
    tls_cert: str = path("Certificate (PEM), for encrypted connections")
    tls_key: str = path("Its key")
    auth: str = word("token", ("token", "none"), "What clients need; none lets in every user of this computer")


@dataclass(frozen=True)
class OutputsConfig:
    """The outputs."""

    pose_socket: PoseSocketConfig = field(default_factory=PoseSocketConfig)
    foxglove: FoxgloveConfig = field(default_factory=FoxgloveConfig)
    ros2: Ros2Config = field(default_factory=Ros2Config)
