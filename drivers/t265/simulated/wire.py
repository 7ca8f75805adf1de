"""Encoding of the camera's messages. Written from the layouts, independent of the driver's decoder."""

from __future__ import annotations

import struct
from typing import TypeAlias

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.messages import Id, Sensor, Status
from stereo_sfm.drivers.t265.protocol import StreamProfile
from stereo_sfm.drivers.t265.simulated.faults import Faults
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, U8

Transfer: TypeAlias = list[bytes | memoryview]  # chunks of one USB transfer, so that pixels are copied only once

OFFERED = [
    StreamProfile(Sensor.LEFT, 848, 800, m.PIXEL_FORMAT_Y8, 848, 30),
    StreamProfile(Sensor.RIGHT, 848, 800, m.PIXEL_FORMAT_Y8, 848, 30),
    StreamProfile(Sensor.GYRO, 0, 0, 0, 0, 200),
    StreamProfile(Sensor.ACCEL, 0, 0, 0, 0, 62),
    StreamProfile(Sensor.GYRO, 0, 0, 0, 0, 100),
    StreamProfile(0x08, 0, 0, 0, 0, 0),
]

# The body: x right, y up, z backward, midway between the cameras. The IMU: x left, y up, z forward.
_OPTICAL_TO_BODY = np.diag([1.0, -1.0, -1.0])
_BODY_T_IMU = se3.from_rotation_translation(np.diag([-1.0, 1.0, -1.0]), np.array([-0.0213, 0.0, 0.0]))


def body_T_left(rig: Rig) -> F64:
    """(4, 4) left camera in the body."""
    return se3.from_rotation_translation(_OPTICAL_TO_BODY, np.array([-rig.left_T_right[0, 3] / 2, 0, 0]))


def left_T_imu(rig: Rig) -> F64:
    """(4, 4) IMU in the left camera."""
    return se3.inverse(body_T_left(rig)) @ _BODY_T_IMU


def reply(message: int, status: int, payload: bytes = b"") -> bytes:
    return struct.pack("<IHH", 8 + len(payload), message, status) + payload


def status_event(status: Status) -> bytes:
    return struct.pack("<IHH", 8, Id.STATUS, status)


def device_info(faults: Faults, serial: str) -> bytes:
    number = int.from_bytes((int(serial, 16) << 16).to_bytes(8, "big"), "little")
    code = 1000 if faults.uncalibrated else 0
    head = (1, 2, 0, 4, 3, *faults.firmware, 7, code, 0)
    return struct.pack("<8B4IQ8BI2B", *head, number, *[0] * 8, 0, 1, 0)


def intrinsics(rig: Rig, sensor: int) -> bytes:
    camera = rig.left if sensor == Sensor.LEFT else rig.right
    assert camera is not None
    return struct.pack(
        "<2I4fI5f", camera.width, camera.height, camera.cx, camera.cy, camera.fx, camera.fy, 4, *camera.distortion, 0.0
    )


def motion_intrinsics(sensor: int) -> bytes:
    noise, bias = (5.148e-6, 5e-7) if sensor == Sensor.GYRO else (6.695e-5, 1e-4)
    matrix = np.hstack([np.eye(3), np.zeros((3, 1))])
    return struct.pack("<18f", *matrix.ravel(), *[noise] * 3, *[bias] * 3)


def extrinsics(rig: Rig, sensor: int) -> bytes:
    left = body_T_left(rig)
    pose = {Sensor.LEFT: left, Sensor.RIGHT: left @ rig.left_T_right}.get(Sensor(sensor), _BODY_T_IMU)
    return struct.pack("<9f3fB", *pose[:3, :3].T.ravel(), *pose[:3, 3], Sensor.POSE)  # column-major


def video_transfer(sensor: int, stamp: int, counter: int, pixels: U8) -> Transfer:
    """Header and pixels of one image."""
    size = m.VIDEO_HEADER + pixels.size
    sample = struct.pack("<IHBBQQI", size, Id.SAMPLE, sensor, 0, stamp, stamp + 9_000_000, counter)
    header = sample + struct.pack("<IIfI", 8, 5000, 1.0, pixels.size)
    return [header, np.ascontiguousarray(pixels).data.cast("B")] if pixels.size else [header]


def motion_sample(sensor: int, stamp: int, counter: int, xyz: F64) -> bytes:
    return struct.pack("<IHBBQQIIfI3f", 52, Id.SAMPLE, sensor, 0, stamp, stamp + 500_000, counter, 4, 38.0, 12, *xyz)
