"""Decoding of the T265's streams: images, inertial samples, statuses. Layouts: t265-messages.h of v2.53.1."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.messages import Id, Sensor
from stereo_sfm.drivers.t265.protocol import Buffer, ProtocolError
from stereo_sfm.types import U8


@dataclass(frozen=True, eq=False)
class VideoSample:
    """The image of one camera."""

    sensor: int
    stamp_ns: int  # camera clock
    frame_id: int  # per sensor, from 0 at START
    exposure_us: int
    gain: float
    pixels: U8  # (800, 848), a view of the transfer's buffer


@dataclass(frozen=True)
class MotionSample:
    """One gyroscope (rad/s) or accelerometer (m/s^2) reading."""

    sensor: int
    stamp_ns: int
    frame_id: int
    celsius: float
    xyz: tuple[float, float, float]


@dataclass(frozen=True)
class StatusEvent:
    """A status of the camera."""

    message: int
    status: int


_SAMPLE = struct.Struct("<IHBBQQI")
_VIDEO = struct.Struct("<IIfI")
_MOTION = struct.Struct("<IfI3f")
MOTION_BYTES = _SAMPLE.size + _MOTION.size
MAX_EXPOSURE_US, MAX_GAIN = 1_000_000, 1000.0
MAX_MOTION = {Sensor.GYRO: 100.0, Sensor.ACCEL: 1000.0}  # far above the range of the BMI055 (35 rad/s, 160 m/s^2)


def decode_video_endpoint(data: Buffer) -> VideoSample | StatusEvent:
    """One transfer of endpoint 0x81: exactly one message.

    Raises:
        ProtocolError: an incomplete or invalid frame.
    """
    if len(data) == 8:
        return _decode_status(data)
    if len(data) != m.VIDEO_BYTES:
        raise ProtocolError(f"video transfer of {len(data)} bytes, not {m.VIDEO_BYTES}")
    length, message, sensor, _, stamp, _, frame_id = _SAMPLE.unpack_from(data)
    metadata, exposure, gain, pixels = _VIDEO.unpack_from(data, _SAMPLE.size)
    if (length, message, metadata, pixels) != (m.VIDEO_BYTES, Id.SAMPLE, 8, m.PIXELS):
        raise ProtocolError("video transfer whose header does not describe a frame")
    if sensor not in (Sensor.LEFT, Sensor.RIGHT):
        raise ProtocolError(f"video transfer of unknown sensor {sensor:#04x}")
    if not 0 <= exposure <= MAX_EXPOSURE_US or not 0 <= gain <= MAX_GAIN:
        raise ProtocolError("video transfer with an impossible exposure")
    image = np.frombuffer(data, np.uint8, m.PIXELS, m.VIDEO_HEADER).reshape(m.HEIGHT, m.WIDTH)
    return VideoSample(sensor, stamp, frame_id, exposure, gain, image)


def _decode_status(data: Buffer) -> StatusEvent:
    length, message, status = struct.unpack("<IHH", data)
    if length != 8 or message not in (Id.STATUS, Id.ERROR, Id.SLAM_ERROR):
        raise ProtocolError("8-byte transfer that is not a status")
    return StatusEvent(message, status)


def decode_events(data: Buffer) -> tuple[list[MotionSample | StatusEvent], int]:
    """One transfer of endpoint 0x83: several messages back to back.

    Returns:
        Decoded messages, and the number of damaged ones (a wrong length loses the rest of the transfer).
    """
    events: list[MotionSample | StatusEvent] = []
    damaged = offset = 0
    while offset < len(data):
        rest = len(data) - offset
        length, message = struct.unpack_from("<IH", data, offset) if rest >= 6 else (0, 0)
        if length < 6 or length > rest:
            return events, damaged + 1
        try:
            event = _decode_event(message, data[offset : offset + length])
        except ProtocolError:
            damaged += 1
        else:
            if event is not None:
                events.append(event)
        offset += length
    return events, damaged


def _decode_event(message: int, data: Buffer) -> MotionSample | StatusEvent | None:
    if message == Id.SAMPLE:
        return _decode_motion(data)
    if message in (Id.STATUS, Id.ERROR, Id.SLAM_ERROR) and len(data) == 8:
        return _decode_status(data)
    if message in (Id.GET_POSE, Id.RELOCALIZATION_EVENT):
        return None  # the camera's own tracking, which is turned off
    raise ProtocolError(f"unknown event {message:#06x}")


def _decode_motion(data: Buffer) -> MotionSample:
    if len(data) != MOTION_BYTES:
        raise ProtocolError(f"motion sample of {len(data)} bytes, not {MOTION_BYTES}")
    _, _, sensor, _, stamp, _, frame_id = _SAMPLE.unpack_from(data)
    metadata, celsius, size, x, y, z = _MOTION.unpack_from(data, _SAMPLE.size)
    if sensor not in (Sensor.GYRO, Sensor.ACCEL) or metadata != 4 or size != 12:
        raise ProtocolError("motion sample whose header does not describe one")
    if not all(abs(v) <= MAX_MOTION[Sensor(sensor)] for v in (x, y, z)):
        raise ProtocolError("motion sample outside the sensor's range")
    return MotionSample(sensor, stamp, frame_id, celsius, (x, y, z))
