"""ROS bags as other programs write them, with the rosbags library, from images of a source."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt
from stereo_sfm.types import F64, U8, StereoImage

KINDS = ("folder of .db3", ".db3", "folder of .mcap", ".bag")
FRAMES = ("left_optical", "right_optical", "imu_link")


class BagWriter:
    """Messages of either ROS into a bag."""

    def __init__(self, path: Path, kind: str) -> None:
        self.ros_1 = kind == ".bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros_1 else Stores.ROS2_JAZZY)
        if self.ros_1:
            row = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(row, "tf2_msgs/msg/TFMessage"))
        self.path = path.with_suffix(".bag") if self.ros_1 else path
        storage = rosbag2.StoragePlugin.MCAP if "mcap" in kind else rosbag2.StoragePlugin.SQLITE3
        self._writer = (
            rosbag1.Writer(self.path) if self.ros_1 else rosbag2.Writer(path, version=9, storage_plugin=storage)
        )
        self._writer.open()
        self._connections: dict[str, Any] = {}

    def make(self, kind: str, *values: Any) -> Any:
        """A message by its type and the values of its fields."""
        return self.store.types[kind](*values)

    def header(self, stamp_ns: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9))
        return self.make("std_msgs/msg/Header", *((0,) if self.ros_1 else ()), time, frame)

    def put(self, topic: str, kind: str, message: Any, stamp_ns: int) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.store)
        data = self.store.serialize_ros1(message, kind) if self.ros_1 else self.store.serialize_cdr(message, kind)
        self._writer.write(self._connections[topic], stamp_ns, bytes(data))

    def close(self) -> None:
        self._writer.close()

    # -- messages -----------------------------------------------------------------------------------------------------

    def image(self, side: str, pixels: U8, stamp_ns: int, frame: str, packed: bool) -> None:
        height, width = pixels.shape
        header = self.header(stamp_ns, frame)
        if packed:
            kind, data = "sensor_msgs/msg/CompressedImage", cv2.imencode(".png", pixels)[1].ravel()
            self.put(f"/camera/{side}/image_raw/compressed", kind, self.make(kind, header, "png", data), stamp_ns)
            return
        kind = "sensor_msgs/msg/Image"
        message = self.make(kind, header, height, width, "mono8", 0, width, pixels.ravel())
        self.put(f"/camera/{side}/image_raw", kind, message, stamp_ns)

    def camera(self, side: str, camera: Camera, stamp_ns: int, frame: str) -> None:
        kind = "sensor_msgs/msg/CameraInfo"
        model = "equidistant" if isinstance(camera, KannalaBrandt) else "plumb_bob"
        roi = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        d, k = np.array(camera.distortion, float), camera.matrix.ravel()
        unknown = np.eye(3).ravel(), np.zeros(12)
        header = self.header(stamp_ns, frame)
        info = self.make(kind, header, camera.height, camera.width, model, d, k, *unknown, 0, 0, roi)
        self.put(f"/camera/{side}/camera_info", kind, info, stamp_ns)

    def transform(self, parent: str, child: str, parent_T_child: F64, stamp_ns: int) -> None:
        q = self.make("geometry_msgs/msg/Quaternion", *se3.quaternion_from_rotation(parent_T_child[:3, :3]))
        moved = self.make("geometry_msgs/msg/Transform", self._vector(parent_T_child[:3, 3]), q)
        row = self.make("geometry_msgs/msg/TransformStamped", self.header(stamp_ns, parent), child, moved)
        kind = "tf2_msgs/msg/TFMessage"
        self.put("/tf_static", kind, self.make(kind, [row]), stamp_ns)

    def imu(self, stamp_ns: int, gyro: F64, accel: F64, topic: str = "/imu/data", logged_ns: int | None = None) -> None:
        """NaN: not measured."""
        kind, zeros = "sensor_msgs/msg/Imu", np.zeros(9)
        covariance = [np.r_[-1.0, np.zeros(8)] if np.isnan(v).any() else zeros for v in (gyro, accel)]
        values = [self._vector(np.nan_to_num(v)) for v in (gyro, accel)]
        level = self.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        header = self.header(stamp_ns, FRAMES[2])
        message = self.make(kind, header, level, zeros, values[0], covariance[0], values[1], covariance[1])
        self.put(topic, kind, message, stamp_ns if logged_ns is None else logged_ns)

    def wheels(self, kind: str, stamp_ns: int, linear: F64, angular: F64, speeds: F64) -> None:
        """Velocities of the robot (3,) each, or with JointState the speeds (2,) of its wheels, on /wheel_odom."""
        twist = self.make("geometry_msgs/msg/Twist", self._vector(linear), self._vector(angular))
        if kind == "sensor_msgs/msg/JointState":
            names, nothing = ["arm", "left_joint", "right_joint"], np.zeros(3)
            values = self.header(stamp_ns, ""), names, nothing, np.r_[7.0, speeds], nothing
        elif kind == "geometry_msgs/msg/TwistStamped":
            values = self.header(stamp_ns, "base_link"), twist
        else:
            point = self.make("geometry_msgs/msg/Point", 0.0, 0.0, 0.0)
            level = self.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
            pose = self.make("geometry_msgs/msg/Pose", point, level)
            unknown = np.zeros(36)
            posed = self.make("geometry_msgs/msg/PoseWithCovariance", pose, unknown)
            moved = self.make("geometry_msgs/msg/TwistWithCovariance", twist, unknown)
            values = self.header(stamp_ns, "odom"), "base_link", posed, moved
        self.put("/wheel_odom", kind, self.make(kind, *values), stamp_ns)

    def _vector(self, xyz: F64) -> Any:
        return self.make("geometry_msgs/msg/Vector3", *map(float, xyz))


def write_bag(
    folder: Path, kind: str, rig: Rig, images: list[StereoImage], packed: bool = False,
    extra: Callable[[BagWriter], None] = lambda bag: None,
) -> Path:  # fmt: skip
    """A bag with images, calibrations, transforms and inertial samples; the path that a user names."""
    bag = BagWriter(folder / "bag", kind)
    start = images[0].stamp_ns
    assert rig.right is not None
    for side, camera, frame in zip(("left", "right"), (rig.left, rig.right), FRAMES, strict=False):
        bag.camera(side, camera, start, frame)
    bag.transform(FRAMES[0], FRAMES[1], rig.left_T_right, start)
    if rig.imu is not None:
        bag.transform(FRAMES[0], FRAMES[2], rig.imu.left_T_imu, start)
    for image in images:
        samples = image.imu
        for i in range(0 if samples is None else len(samples)):
            assert samples is not None
            bag.imu(int(samples.stamp_ns[i]), samples.gyro[i], samples.accel[i])
        assert image.right is not None
        bag.image("left", image.left, image.stamp_ns, FRAMES[0], packed)
        bag.image("right", image.right, image.stamp_ns, FRAMES[1], packed)
    extra(bag)
    bag.close()
    return next(bag.path.glob("*.db3")) if kind == ".db3" else bag.path


def compressed_bag(path: Path, mode: rosbag2.CompressionMode, plugin: rosbag2.StoragePlugin) -> Path:
    """A copy of a folder's bag."""
    writer = rosbag2.Writer(path.with_name("compressed"), version=9, storage_plugin=plugin)
    writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    return copied(rosbag2.Reader(path), writer, "rihs01")


def copied(reader: Any, writer: Any, digest: str) -> Path:
    """Write a bag's messages into another one. `digest`: what the writer calls the checksum of a type."""
    with reader, writer:
        of = {
            c.id: writer.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, **{digest: c.digest})
            for c in reader.connections
        }
        for connection, time_ns, data in reader.messages():
            writer.write(of[connection.id], time_ns, data)
    return writer.path
