"""`PoseMessage`: one pose for other programs, as a line of JSON or as protobuf."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, field, fields

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.log import schema
from stereo_sfm.service.messages import PoseUpdate
from stereo_sfm.service.outputs.robot_axes import RobotAxes
from stereo_sfm.types import F64, Message, shape


@dataclass(frozen=True, eq=False)
class PoseMessage(Message):
    """A pose of the robot. Metres, radians, nanoseconds; quaternions are x y z w; axes as `RobotAxes`."""

    stamp_ns: int  # of the image, the camera's clock
    unix_ns: int  # the same instant on this computer's clock
    frame_id: int
    session: int  # grows when tracking begins anew: odom begins again
    state: str  # OK, LOST, ...
    reason: str  # "" when OK
    tracked: bool  # the pose comes from this image
    localized: bool  # map is the frame of the saved map
    map_version: int
    map_position: F64  # (3,) of the robot in map, which may jump
    map_quaternion: F64  # (4,)
    odom_position: F64  # (3,) of the robot in odom, which is continuous
    odom_quaternion: F64  # (4,)
    covariance: F64 = field(metadata=shape(6, 6))  # (6, 6) in odom: x y z, rotations about x y z
    twist: F64  # (6,) m/s and rad/s in the robot's axes; NaN (in JSON null) where unknown
    twist_covariance: F64 = field(metadata=shape(6, 6))
    latency_ms: float  # from the image's arrival to this message


MISSED_FIELD = len(fields(PoseMessage)) + 1  # poses before this one that the client was too slow for


def pose_message(update: PoseUpdate, axes: RobotAxes) -> PoseMessage:
    """What is sent about a pose now."""
    pose = axes.pose(update)
    map_T_base = pose.map_T_base
    return PoseMessage(
        update.stamp_ns,
        update.unix_ns,
        update.frame_id,
        update.session,
        update.state,
        update.reason,
        update.tracked,
        update.localized,
        update.map_version,
        map_T_base[:3, 3].copy(),
        se3.quaternion_from_rotation(map_T_base[:3, :3]),
        pose.odom_T_base[:3, 3].copy(),
        se3.quaternion_from_rotation(pose.odom_T_base[:3, :3]),
        pose.covariance,
        pose.twist,
        pose.twist_covariance,
        (time.monotonic() - update.captured_s) * 1e3,
    )


class JsonFormat:
    """One line of JSON a message."""

    def body(self, message: PoseMessage) -> bytes:
        """The part that is the same for all clients."""
        values = {f.name: _plain(getattr(message, f.name)) for f in fields(message)}
        return json.dumps(values, separators=(",", ":"), allow_nan=False).encode()

    def framed(self, body: bytes, missed: int) -> bytes:
        """A message for one client."""
        return b'%s,"missed":%d}\n' % (body[:-1], missed)


class ProtobufFormat:
    """The length as four bytes, little-endian, then a message of `pose.proto`."""

    def body(self, message: PoseMessage) -> bytes:
        """The part that is the same for all clients."""
        return schema.encode(message)

    def framed(self, body: bytes, missed: int) -> bytes:
        """A message for one client: in protobuf, fields may be appended (a sint64 is a zigzag varint)."""
        whole = body + _varint(MISSED_FIELD << 3) + _varint(2 * missed)
        return len(whole).to_bytes(4, "little") + whole


FORMATS = {"json": JsonFormat, "protobuf": ProtobufFormat}


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _plain(value: object) -> object:
    """As JSON values: JSON has no NaN."""
    if isinstance(value, np.ndarray):
        flat = value.ravel()
        numbers: list[float | None] = flat.tolist()
        return numbers if np.isfinite(flat).all() else [v if math.isfinite(v) else None for v in flat.tolist()]
    return None if isinstance(value, float) and not math.isfinite(value) else value
