"""Constants of the T265's run-time protocol: ids, sensors, statuses, sizes (librealsense 2.53.1, t265-messages.h).

Little-endian, packed. A request starts with u32 length, u16 id; a response adds u16 status.
"""

from __future__ import annotations

import enum

BOOT_ID = (0x03E7, 0x2150)  # no firmware yet. Exactly this product: 03e7:2485 and 03e7:f63b are OAK cameras
RUN_IDS = ((0x8087, 0x0B37), (0x8087, 0x0AF3))  # T265, T260

COMMAND_OUT, COMMAND_IN, VIDEO_IN, EVENT_IN, BOOT_OUT = 0x02, 0x82, 0x81, 0x83, 0x01

WIDTH, HEIGHT, FRAME_RATE = 848, 800, 30
PIXELS = WIDTH * HEIGHT
VIDEO_HEADER = 44
VIDEO_BYTES = VIDEO_HEADER + PIXELS
VIDEO_BUFFER = 663 * 1024  # next multiple of a SuperSpeed packet: a frame ends in a short packet
EVENT_BUFFER = 1024
COMMAND_BUFFER = 1024
PERIOD_NS = 1_000_000_000 // FRAME_RATE
GYRO_HZ, ACCEL_HZ = 200.0, 62.5
MIN_EXPOSURE_US, MAX_EXPOSURE_US = 200, 16_000  # librealsense's limits; the camera rejects values below 200
MIN_GAIN, MAX_GAIN = 1.0, 10.0


class Id(enum.IntEnum):
    """Messages that this driver sends or decodes."""

    GET_DEVICE_INFO = 0x0001
    GET_TIME = 0x0002
    GET_SUPPORTED_RAW_STREAMS = 0x0004
    RAW_STREAMS_CONTROL = 0x0005
    GET_CAMERA_INTRINSICS = 0x0006
    GET_MOTION_INTRINSICS = 0x0007
    GET_EXTRINSICS = 0x0008
    SAMPLE = 0x0011
    START = 0x0012
    STOP = 0x0013
    STATUS = 0x0014
    GET_POSE = 0x0015
    EXPOSURE_MODE_CONTROL = 0x0016
    SET_EXPOSURE = 0x0017
    GET_TEMPERATURE = 0x0018
    SET_LOW_POWER_MODE = 0x0025
    SLAM_6DOF_CONTROL = 0x1006
    RELOCALIZATION_EVENT = 0x100E
    ERROR = 0x8000
    SLAM_ERROR = 0x9000


# The only ids that may be sent. All others, in particular those that write EEPROM, configuration or calibration, are
# refused by the one function that writes commands (link.py).
SENDABLE = frozenset(
    {
        Id.GET_DEVICE_INFO,
        Id.GET_TIME,
        Id.GET_SUPPORTED_RAW_STREAMS,
        Id.RAW_STREAMS_CONTROL,
        Id.GET_CAMERA_INTRINSICS,
        Id.GET_MOTION_INTRINSICS,
        Id.GET_EXTRINSICS,
        Id.START,
        Id.STOP,
        Id.EXPOSURE_MODE_CONTROL,
        Id.SET_EXPOSURE,
        Id.GET_TEMPERATURE,
        Id.SET_LOW_POWER_MODE,
        Id.SLAM_6DOF_CONTROL,
    }
)


class Sensor(enum.IntEnum):
    """Sensor byte: type in bits 0-4, index above."""

    LEFT = 0x03
    RIGHT = 0x23
    GYRO = 0x04
    ACCEL = 0x05
    POSE = 0x0A


PIXEL_FORMAT_Y8 = 9
KANNALA_BRANDT_4 = 4


class Status(enum.IntEnum):
    """Status of a response."""

    SUCCESS = 0x0000
    UNKNOWN_MESSAGE_ID = 0x0001
    INVALID_REQUEST_LEN = 0x0002
    INVALID_PARAMETER = 0x0003
    INTERNAL_ERROR = 0x0004
    UNSUPPORTED = 0x0005
    LIST_TOO_BIG = 0x0006
    MORE_DATA_AVAILABLE = 0x0007
    DEVICE_BUSY = 0x0008
    TIMEOUT = 0x0009
    TABLE_NOT_EXIST = 0x000A
    TABLE_LOCKED = 0x000B
    DEVICE_STOPPED = 0x000C
    TEMPERATURE_WARNING = 0x0010
    TEMPERATURE_STOP = 0x0011
    CRC_ERROR = 0x0012
    INCOMPATIBLE = 0x0013
    AUTH_ERROR = 0x0014
    DEVICE_RESET = 0x0015
    SLAM_NO_DICTIONARY = 0x9001


def status_name(status: int) -> str:
    """Readable name of a status."""
    try:
        return Status(status).name
    except ValueError:
        return f"status {status:#06x}"


class AntiFlicker(enum.IntEnum):
    """Mains frequency for the flicker suppression of the automatic exposure."""

    OFF = 0
    HZ_50 = 1
    HZ_60 = 2
