"""Messages of other programs in common types: images, calibrations, transforms of Foxglove (protobuf) and ROS 2.

CDR is the plain form of OMG's Common Data Representation: a four-byte header, then fields aligned to their own size
counted from the end of that header; strings are preceded by their length including the terminating zero.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError

from stereo_sfm.calib.formats.camera_info import CameraInfo, info_from_rows
from stereo_sfm.geometry import se3
from stereo_sfm.log import foxglove, images
from stereo_sfm.log.reader import Record
from stereo_sfm.pixels import PNG, decode_gray
from stereo_sfm.types import F32, F64, U8, U16

# Parts of the names that encoders go by (libx264, hevc_nvenc) -> FFmpeg's decoder.
VIDEO = {"264": "h264", "265": "hevc", "hevc": "hevc", "av1": "libdav1d", "vp8": "vp8", "vp9": "vp9"}
NOTHING = (float("nan"),) * 3  # what is not measured
# Exceptions of damaged or unexpected messages; LookupError: a topic may have messages of several types.
BAD_MESSAGE = (ValueError, DecodeError, struct.error, LookupError)


@dataclass(frozen=True)
class ImageMessage:
    """An image, not decoded."""

    stamp_ns: int  # 0 where the message has none
    frame: str
    compressed: bool
    data: bytes
    width: int = 0
    height: int = 0
    step: int = 0
    encoding: str = ""
    big_endian: bool = False
    inverse: tuple[float, float] | None = None  # of `decode_depth_file`

    @property
    def video(self) -> str:
        """FFmpeg's decoder of a message that is a part of a video, "" for an image of its own."""
        name = self.encoding.lower() if self.compressed else ""
        return next((decoder for part, decoder in VIDEO.items() if part in name), "")

    def gray(self) -> U8 | U16:
        """(H, W) with the depth of the message.

        Raises:
            UnknownEncoding: no image of the topic can be read.
            ValueError: this one cannot.
        """
        if self.video:  # `stereo_sfm.drivers.mcap.video` decodes those of recordings
            raise images.UnknownEncoding(f"'{self.encoding}' is video, which is read from recordings only")
        if self.compressed:
            stated, _, how = self.encoding.partition(";")  # "bayer_rggb8; jpeg compressed": of what was compressed
            as_it_was = how.partition("compressed")[2].strip() in ("", stated)
            pixels = decode_gray(self.data)
            return images.without_mosaic(pixels, stated) if as_it_was else pixels
        return images.decode_raw(self.data, self.width, self.height, self.step, self.encoding, self.big_endian)

    def depth(self) -> F32:
        """(H, W) metres, NaN where unknown."""
        if self.compressed:
            return images.decode_depth_file(self.data, self.inverse)
        return images.decode_depth(self.data, self.width, self.height, self.step, self.encoding)


@dataclass(frozen=True)
class Transform:
    """parent_T_child, or a pose (4, 4) of something unnamed in `parent`."""

    stamp_ns: int
    parent: str
    child: str
    matrix: F64


@dataclass(frozen=True)
class ImuReading:
    """One inertial message."""

    stamp_ns: int
    frame: str
    values: list[float]  # (6,) rad/s and m/s^2 in the IMU's frame, NaN for what the message does not measure


@dataclass(frozen=True)
class WheelReading:
    """One message of a robot's motion: velocities in its own axes, or the speeds of its joints."""

    stamp_ns: int
    frame: str  # of the robot
    linear: tuple[float, ...] = (float("nan"),) * 3  # m/s
    angular: tuple[float, ...] = (float("nan"),) * 3  # rad/s
    joints: dict[str, float] = field(default_factory=dict[str, float])  # rad/s


class _Cdr:
    """Reads CDR fields one after the other."""

    def __init__(self, data: bytes) -> None:
        if len(data) < 4:
            raise ValueError("a ROS 2 message without header")
        self._data = memoryview(data)[4:]
        self._order = "<" if data[1] & 1 else ">"
        self._at = 0

    def take(self, kind: str, count: int = 1) -> Any:
        """One number of a struct letter, or a tuple when `count` is not 1."""
        size = struct.calcsize(kind)
        self._at += -self._at % size
        values = struct.unpack_from(f"{self._order}{count}{kind}", self._data, self._at)
        self._at += size * count
        return values[0] if count == 1 else values

    def blob(self) -> bytes:
        """A sequence of bytes."""
        length = self.take("I")
        out = bytes(self._data[self._at : self._at + length])
        if len(out) != length:
            raise ValueError("a ROS 2 message is truncated")
        self._at += length
        return out

    def text(self) -> str:
        return self.blob().rstrip(b"\0").decode(errors="replace")

    def header(self) -> tuple[int, str]:
        """(stamp_ns, frame_id)."""
        seconds, nanos = self.take("i"), self.take("I")
        return seconds * 1_000_000_000 + nanos, self.text()

    def pose(self) -> F64:
        """Position and quaternion -> (4, 4)."""
        v = np.array(self.take("d", 7))
        rotation = se3.rotation_from_quaternion(v[3:]) if v[3:].any() else np.eye(3)
        return se3.from_rotation_translation(rotation, v[:3])


def _image_foxglove_raw(data: bytes) -> ImageMessage:
    m = RawImage.FromString(data)
    return ImageMessage(foxglove.stamp_of(m), m.frame_id, False, m.data, m.width, m.height, m.step, m.encoding)


def _image_foxglove_compressed(data: bytes) -> ImageMessage:
    m = CompressedImage.FromString(data)
    return ImageMessage(foxglove.stamp_of(m), m.frame_id, True, m.data, encoding=m.format)


def _video_foxglove(data: bytes) -> ImageMessage:
    m = CompressedVideo.FromString(data)
    return ImageMessage(foxglove.stamp_of(m), m.frame_id, True, m.data, encoding=m.format)


def _image_ros_raw(data: bytes) -> ImageMessage:
    cdr = _Cdr(data)
    stamp_ns, frame = cdr.header()
    height, width, encoding = cdr.take("I"), cdr.take("I"), cdr.text()
    big, step = bool(cdr.take("B")), cdr.take("I")
    return ImageMessage(stamp_ns, frame, False, cdr.blob(), width, height, step, encoding, big)


def _image_ros_compressed(data: bytes) -> ImageMessage:
    cdr = _Cdr(data)
    stamp_ns, frame = cdr.header()
    encoding = cdr.text()
    blob = cdr.blob()
    inverse: tuple[float, float] | None = None
    if "compressedDepth" in encoding:  # the depth transport has a header before the PNG
        if encoding.startswith("32FC1"):
            inverse = struct.unpack_from("<ff", blob, 4)
        blob = blob[max(blob.find(PNG), 0) :]
    return ImageMessage(stamp_ns, frame, True, blob, encoding=encoding, inverse=inverse)


def _video_ros(data: bytes) -> ImageMessage:
    """foxglove_msgs/msg/CompressedVideo."""
    cdr = _Cdr(data)
    stamp_ns, frame = cdr.header()
    blob = cdr.blob()
    return ImageMessage(stamp_ns, frame, True, blob, encoding=cdr.text())


def _packet_ros(data: bytes) -> ImageMessage:
    """ffmpeg_image_transport_msgs/msg/FFMPEGPacket: after the encoding the encoder's time, flags, byte order."""
    cdr = _Cdr(data)
    stamp_ns, frame = cdr.header()
    cdr.take("i", 2)
    encoding = cdr.text()
    cdr.take("Q")
    cdr.take("B", 2)
    return ImageMessage(stamp_ns, frame, True, cdr.blob(), encoding=encoding)


def _camera_foxglove(data: bytes) -> CameraInfo:
    m = CameraCalibration.FromString(data)
    return info_from_rows(m.width, m.height, m.distortion_model, list(m.K), list(m.D), list(m.R), list(m.P), m.frame_id)


def _camera_ros(data: bytes) -> CameraInfo:
    cdr = _Cdr(data)
    _, frame = cdr.header()
    height, width, model = cdr.take("I"), cdr.take("I"), cdr.text()
    d = [cdr.take("d") for _ in range(cdr.take("I"))]
    return info_from_rows(width, height, model, cdr.take("d", 9), d, cdr.take("d", 9), cdr.take("d", 12), frame)


def _transform(m: FrameTransform) -> Transform:
    return Transform(
        foxglove.stamp_of(m), m.parent_frame_id, m.child_frame_id, foxglove.matrix(m.translation, m.rotation)
    )


def _transforms_ros(data: bytes) -> list[Transform]:
    cdr = _Cdr(data)
    out: list[Transform] = []
    for _ in range(cdr.take("I")):
        stamp_ns, parent = cdr.header()
        out.append(Transform(stamp_ns, parent, cdr.text(), cdr.pose()))
    return out


def _pose_foxglove(data: bytes) -> Transform:
    m = PoseInFrame.FromString(data)
    return Transform(foxglove.stamp_of(m), m.frame_id, "", foxglove.matrix(m.pose.position, m.pose.orientation))


def _pose_ros(data: bytes) -> Transform:
    cdr = _Cdr(data)
    stamp_ns, parent = cdr.header()
    return Transform(stamp_ns, parent, "", cdr.pose())


def _odometry_ros(data: bytes) -> Transform:
    cdr = _Cdr(data)
    stamp_ns, parent = cdr.header()
    return Transform(stamp_ns, parent, cdr.text(), cdr.pose())


def _imu_ros(data: bytes) -> ImuReading:
    """A covariance of -1 stands for a quantity that is not measured (sensor_msgs/Imu).

    So does a force of exactly zero, beside which a sensor that measures both would have to fall freely.
    """
    cdr = _Cdr(data)
    stamp_ns, frame = cdr.header()
    cdr.take("d", 13)
    gyro, gyro_known = cdr.take("d", 3), cdr.take("d", 9)[0] != -1
    accel, accel_known = cdr.take("d", 3), cdr.take("d", 9)[0] != -1
    accel_known = accel_known and any(accel)
    return ImuReading(stamp_ns, frame, [*(gyro if gyro_known else NOTHING), *(accel if accel_known else NOTHING)])


def half_of(reading: ImuReading, gyro: bool) -> ImuReading:
    """The gyroscope's half of a message, or the accelerometer's: drivers with a topic for each fill the other half
    with zeros."""
    values = [*reading.values[:3], *NOTHING] if gyro else [*NOTHING, *reading.values[3:]]
    return replace(reading, values=values)


def _odometry_velocity_ros(data: bytes) -> WheelReading:
    cdr = _Cdr(data)
    stamp_ns, _ = cdr.header()
    frame = cdr.text()
    cdr.take("d", 7 + 36)
    return WheelReading(stamp_ns, frame, cdr.take("d", 3), cdr.take("d", 3))


def _twist_ros(data: bytes) -> WheelReading:
    cdr = _Cdr(data)
    stamp_ns, frame = cdr.header()
    return WheelReading(stamp_ns, frame, cdr.take("d", 3), cdr.take("d", 3))


def _joints_ros(data: bytes) -> WheelReading:
    """Speeds of joints; without any, none."""
    cdr = _Cdr(data)
    stamp_ns, frame = cdr.header()
    names = [cdr.text() for _ in range(cdr.take("I"))]
    _, speeds = ([float(cdr.take("d")) for _ in range(cdr.take("I"))] for _ in range(2))
    known = dict(zip(names, speeds, strict=True)) if len(speeds) == len(names) else {}
    return WheelReading(stamp_ns, frame, joints=known)


IMAGES: dict[str, Callable[[bytes], ImageMessage]] = {
    "foxglove.RawImage": _image_foxglove_raw,
    "foxglove.CompressedImage": _image_foxglove_compressed,
    "foxglove.CompressedVideo": _video_foxglove,
    "sensor_msgs/msg/Image": _image_ros_raw,
    "sensor_msgs/msg/CompressedImage": _image_ros_compressed,
    "foxglove_msgs/msg/CompressedVideo": _video_ros,
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": _packet_ros,
}
CAMERAS: dict[str, Callable[[bytes], CameraInfo]] = {
    "foxglove.CameraCalibration": _camera_foxglove,
    "sensor_msgs/msg/CameraInfo": _camera_ros,
}
TRANSFORMS: dict[str, Callable[[bytes], list[Transform]]] = {
    "foxglove.FrameTransforms": lambda data: [_transform(t) for t in FrameTransforms.FromString(data).transforms],
    "foxglove.FrameTransform": lambda data: [_transform(FrameTransform.FromString(data))],
    "tf2_msgs/msg/TFMessage": _transforms_ros,
}
POSES: dict[str, Callable[[bytes], Transform]] = {
    "foxglove.PoseInFrame": _pose_foxglove,
    "geometry_msgs/msg/PoseStamped": _pose_ros,
    "nav_msgs/msg/Odometry": _odometry_ros,
}
IMUS: dict[str, Callable[[bytes], ImuReading]] = {"sensor_msgs/msg/Imu": _imu_ros}
VELOCITIES: dict[str, Callable[[bytes], WheelReading]] = {
    "nav_msgs/msg/Odometry": _odometry_velocity_ros,
    "geometry_msgs/msg/TwistStamped": _twist_ros,
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist_ros,
}
JOINTS: dict[str, Callable[[bytes], WheelReading]] = {"sensor_msgs/msg/JointState": _joints_ros}
ENCODINGS = ("protobuf", "cdr")


def schema_name(record: Record) -> str:
    """Full name of a record's schema, "" for none."""
    return record.schema.name if record.schema is not None else ""
