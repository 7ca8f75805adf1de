"""Encode the T265's commands and decode their answers: bytes in, values out. Layouts: t265-messages.h of v2.53.1."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from stereo_sfm.drivers.live.errors import DeviceFault
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.messages import Id, Sensor
from stereo_sfm.types import F64

Buffer: TypeAlias = bytes | bytearray | memoryview


class ProtocolError(DeviceFault):
    """Bytes that are not the expected message."""


# ---- requests


def request(message: Id, payload: bytes = b"") -> bytes:
    """6-byte header (length of the whole message, id) and the payload."""
    return struct.pack("<IH", 6 + len(payload), message) + payload


def low_power(enabled: bool) -> bytes:
    return request(Id.SET_LOW_POWER_MODE, struct.pack("<BB", enabled, 0))


def camera_intrinsics(sensor: int) -> bytes:
    return request(Id.GET_CAMERA_INTRINSICS, bytes([sensor]))


def motion_intrinsics(sensor: int) -> bytes:
    return request(Id.GET_MOTION_INTRINSICS, bytes([sensor]))


def extrinsics(sensor: int) -> bytes:
    return request(Id.GET_EXTRINSICS, bytes([sensor]))


def exposure_mode(auto: bool, anti_flicker: m.AntiFlicker) -> bytes:
    """Automatic exposure of both cameras, or of none. Only while stopped."""
    return request(Id.EXPOSURE_MODE_CONTROL, struct.pack("<BB", 3 if auto else 0, anti_flicker if auto else 0))


def set_exposure(exposure_us: int, gain: float) -> bytes:
    """The same manual exposure for both cameras."""
    entries = b"".join(struct.pack("<B3xIf", side, exposure_us, gain) for side in (Sensor.LEFT, Sensor.RIGHT))
    return request(Id.SET_EXPOSURE, struct.pack("<BB", 2, 0) + entries)


def six_dof(enabled: bool) -> bytes:
    """The camera's own tracking; with mapping and relocalisation when on."""
    return request(Id.SLAM_6DOF_CONTROL, struct.pack("<BB", enabled, 0x06 if enabled else 0))


@dataclass(frozen=True)
class StreamProfile:
    """One raw stream, offered or requested."""

    sensor: int
    width: int
    height: int
    pixel_format: int
    stride: int
    rate_hz: int
    to_host: bool = False

    _LAYOUT = struct.Struct("<BBHHBBHH")

    def encode(self) -> bytes:
        return self._LAYOUT.pack(
            self.sensor, 0, self.width, self.height, self.pixel_format, self.to_host, self.stride, self.rate_hz
        )

    @classmethod
    def decode(cls, data: Buffer, offset: int) -> StreamProfile:
        sensor, _, width, height, pixel_format, _, stride, rate = cls._LAYOUT.unpack_from(data, offset)
        return cls(sensor, width, height, pixel_format, stride, rate)


def raw_streams(profiles: Sequence[StreamProfile]) -> bytes:
    """Streams that are not listed are off."""
    return request(Id.RAW_STREAMS_CONTROL, struct.pack("<H", len(profiles)) + b"".join(p.encode() for p in profiles))


# ---- responses


@dataclass(frozen=True)
class DeviceInfo:
    """Identity of the camera."""

    firmware: str
    serial: str
    calibrated: bool
    healthy: bool
    eeprom: str
    product: str  # "T265" or "T260"


@dataclass(frozen=True, eq=False)
class CameraIntrinsics:
    """Factory calibration of one Kannala-Brandt camera, px."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class MotionIntrinsics:
    """corrected = scale @ raw + bias, with variances."""

    scale: F64  # (3, 3)
    bias: F64  # (3,)
    noise_variance: F64  # (3,)
    bias_variance: F64  # (3,)


@dataclass(frozen=True)
class Temperature:
    """One temperature probe, degrees Celsius."""

    index: int  # 0 vision processor, 1 IMU, 2 Bluetooth
    celsius: float
    threshold: float


def response_payload(data: Buffer, message: int) -> tuple[int, Buffer]:
    """Check length and id of a response.

    Returns:
        Status and the payload after the 8-byte header.
    """
    if len(data) < 8:
        raise ProtocolError(f"T265 answered {len(data)} bytes, less than a header")
    length, got, status = struct.unpack_from("<IHH", data)
    if length != len(data):
        raise ProtocolError(f"T265 answered {len(data)} bytes but states a length of {length}")
    if got != message:
        raise ProtocolError(f"T265 answered message {got:#06x} to {message:#06x}")
    return status, data[8:]


def _unpack(layout: str, payload: Buffer, what: str) -> tuple[int | float, ...]:
    size = struct.calcsize(layout)
    if len(payload) != size:
        raise ProtocolError(f"T265's {what} has {len(payload)} bytes, not {size}")
    values = struct.unpack(layout, payload)
    if not all(math.isfinite(v) for v in values):
        raise ProtocolError(f"T265's {what} has numbers that are not finite")
    return values


def serial_text(serial: int) -> str:
    """The USB serial string: bytes swapped, upper 48 bits, 12 hexadecimal digits."""
    return f"{int.from_bytes(serial.to_bytes(8, 'little'), 'big') >> 16:012X}"


def decode_device_info(payload: Buffer) -> DeviceInfo:
    v = [int(x) for x in _unpack("<8B4IQ8BI2B", payload, "device info")]
    return DeviceInfo(
        firmware=f"{v[5]}.{v[6]}.{v[7]}.{v[8]}",
        serial=serial_text(v[12]),
        calibrated=v[10] != 1000,
        healthy=v[2] & 0x0F != 1 and v[10] != 1,
        eeprom=f"{v[3]}.{v[4]}",
        product="T260" if v[23] == 1 else "T265",
    )


def decode_time(payload: Buffer) -> int:
    """Nanoseconds since the camera started."""
    return int(_unpack("<Q", payload, "time")[0])


def _counted(payload: Buffer, layout: str, what: str) -> list[tuple[int | float, ...]]:
    (count,) = struct.unpack_from("<I", payload) if len(payload) >= 4 else (0,)
    size = struct.calcsize(layout)
    if len(payload) != 4 + count * size:
        raise ProtocolError(f"T265's {what} has {len(payload)} bytes for {count} entries")
    return [_unpack(layout, payload[4 + i * size : 4 + (i + 1) * size], what) for i in range(count)]


def decode_streams(payload: Buffer) -> list[StreamProfile]:
    """u16 count, u16 reserved, then 12 bytes each."""
    count = struct.unpack_from("<H", payload)[0] if len(payload) >= 4 else -1
    if len(payload) != 4 + 12 * count:
        raise ProtocolError(f"T265's stream list has {len(payload)} bytes for {count} streams")
    return [StreamProfile.decode(payload, 4 + 12 * i) for i in range(count)]


def decode_temperature(payload: Buffer) -> list[Temperature]:
    return [Temperature(int(i), t, limit) for i, t, limit in _counted(payload, "<Iff", "temperature")]


def decode_camera_intrinsics(payload: Buffer) -> CameraIntrinsics:
    v = _unpack("<2I4fI5f", payload, "camera intrinsics")
    if v[6] != m.KANNALA_BRANDT_4:
        raise ProtocolError(f"T265's camera intrinsics use lens model {v[6]}, not Kannala-Brandt (4)")
    return CameraIntrinsics(int(v[0]), int(v[1]), v[4], v[5], v[2], v[3], (v[7], v[8], v[9], v[10]))


def decode_motion_intrinsics(payload: Buffer) -> MotionIntrinsics:
    v = np.array(_unpack("<18f", payload, "motion intrinsics"))
    matrix = v[:12].reshape(3, 4)
    return MotionIntrinsics(matrix[:, :3], matrix[:, 3], v[12:15], v[15:18])


def decode_extrinsics(payload: Buffer) -> F64:
    """(4, 4) body_T_sensor. The rotation is column-major on the wire."""
    v = _unpack("<12fB", payload, "extrinsics")
    if v[12] != Sensor.POSE:
        raise ProtocolError(f"T265's extrinsics refer to sensor {v[12]:#04x}, not the body")
    out = np.eye(4)
    out[:3, :3] = np.array(v[:9]).reshape(3, 3).T
    out[:3, 3] = v[9:12]
    return out
