"""A stand-in for pyrealsense2: a camera with an infrared pair and an IMU, and its recordings, in this process."""

from __future__ import annotations

import enum
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

W, H, PERIOD_MS = 64, 48, 10.0


class Stream(enum.Enum):
    infrared = 1
    gyro = 2
    accel = 3
    depth = 4


@dataclass(frozen=True)
class Profile:
    """A stream at a position (m) on the camera."""

    stream: Stream
    index: int
    x: float

    def stream_type(self) -> Stream:
        return self.stream

    def stream_index(self) -> int:
        return self.index

    def fps(self) -> int:
        return round(1e3 / PERIOD_MS)

    def as_video_stream_profile(self) -> Profile:
        return self

    def get_intrinsics(self) -> Any:
        numbers = {"width": W, "height": H, "fx": 50.0, "fy": 51.0, "ppx": 32.0, "ppy": 24.0}
        return SimpleNamespace(**numbers, coeffs=[0.0] * 5, model="brown_conrady")

    def get_extrinsics_to(self, other: Profile) -> Any:
        return SimpleNamespace(rotation=[1, 0, 0, 0, 1, 0, 0, 0, 1], translation=[self.x - other.x, 0, 0])


LEFT, RIGHT = Profile(Stream.infrared, 1, 0.0), Profile(Stream.infrared, 2, 0.05)
GYRO, ACCEL = Profile(Stream.gyro, 0, 0.01), Profile(Stream.accel, 0, 0.01)


@dataclass(frozen=True)
class Frame:
    """Image or sample number `number`."""

    profile: Profile
    number: int
    stamp_ms: float
    emitter: bool = False
    clock: str = "hardware"
    metadata: dict[str, float] = field(default_factory=dict[str, float])

    def is_frameset(self) -> bool:
        return False

    def is_motion_frame(self) -> bool:
        return self.profile.stream in (Stream.gyro, Stream.accel)

    def as_motion_frame(self) -> Frame:
        return self

    def get_profile(self) -> Profile:
        return self.profile

    def get_data(self) -> Any:
        return np.full((H, W), 10 * self.profile.index + self.number % 10, np.uint8)

    def get_motion_data(self) -> Any:
        return SimpleNamespace(x=1.0, y=2.0, z=3.0)

    def get_frame_number(self) -> int:
        return self.number

    def get_timestamp(self) -> float:
        return self.stamp_ms

    def get_frame_timestamp_domain(self) -> str:
        return self.clock

    def _values(self) -> dict[str, float]:
        known = {"actual_exposure": 4000.0, "gain_level": 32.0, "frame_laser_power_mode": float(self.emitter)}
        return {**known, **self.metadata}

    def supports_frame_metadata(self, key: str) -> bool:
        return key in self._values()

    def get_frame_metadata(self, key: str) -> float:
        return self._values()[key]


def frames(count: int, alternate: bool = False, first: int = 0, imu_clock: str = "hardware") -> list[Frame]:
    """What a camera sends: each pair after the samples before it."""
    found: list[Frame] = []
    for k in range(first, first + count):
        at = 1000.0 + PERIOD_MS * k
        found += [Frame(profile, k, at - 3.0, clock=imu_clock) for profile in (GYRO, ACCEL)]
        found += [Frame(profile, k, at, alternate and k % 2 == 1) for profile in (LEFT, RIGHT)]
    return found


class Names:
    """Any name stands for itself, as of `rs.option`."""

    def __getattr__(self, name: str) -> str:
        return name


@dataclass
class Sensor:
    depth: bool
    profiles: list[Profile]
    options: dict[str, float] = field(default_factory=dict[str, float])
    callback: Callable[[Frame], None] | None = None

    def is_depth_sensor(self) -> bool:
        return self.depth

    def is_motion_sensor(self) -> bool:
        return not self.depth

    def supports(self, name: str) -> bool:
        return self.depth or name == "global_time_enabled"

    def set_option(self, name: str, value: float) -> None:
        self.options[name] = value

    def get_stream_profiles(self) -> list[Profile]:
        return self.profiles

    def open(self, profiles: list[Profile]) -> None:
        assert set(profiles) <= set(self.profiles)

    def start(self, callback: Callable[[Frame], None]) -> None:
        self.callback = callback

    def stop(self) -> None:
        self.callback = None

    def close(self) -> None:
        return


class Library:
    """`pyrealsense2` with one camera, "123", that sends `sent` and can be unplugged."""

    stream, option, camera_info = Stream, Names(), Names()
    frame_metadata_value, distortion, format = Names(), Names(), Names()
    playback_status = SimpleNamespace(stopped="stopped")
    timestamp_domain = SimpleNamespace(hardware_clock="hardware")

    def __init__(self, sent: list[Frame], profiles: tuple[Profile, ...] = (LEFT, RIGHT, GYRO, ACCEL)) -> None:
        self.sent, self.attached, self.starts = sent, True, 0
        video = [one for one in profiles if one.stream is Stream.infrared]
        self.sensors = [Sensor(True, video), Sensor(False, [one for one in profiles if one not in video])]
        self.requested: list[tuple[Any, ...]] = []

    # a device and the context that has it
    def context(self) -> Library:
        return self

    def query_devices(self) -> list[Library]:
        return [self] if self.attached else []

    def query_sensors(self) -> list[Sensor]:
        return self.sensors

    def get_info(self, name: str) -> str:
        return {"serial_number": "123", "name": "D435I"}.get(name, "3.2")

    # a pipeline, its configuration and its queue
    def config(self) -> Library:
        return self

    def enable_device(self, serial: str) -> None:
        assert serial == "123"

    def enable_stream(self, *what: Any) -> None:
        self.requested.append(what)

    def pipeline(self) -> Library:
        return self

    def frame_queue(self, size: int) -> Library:
        return self

    def start(self, config: Any, queue: Any) -> Library:
        self.starts += 1
        return self

    def get_streams(self) -> list[Profile]:
        return [one for sensor in self.sensors for one in sensor.profiles]

    def get_device(self) -> Library:
        return self

    def try_wait_for_frame(self, timeout_ms: int) -> tuple[bool, Frame | None]:
        if self.attached and self.sent:
            return True, self.sent.pop(0)
        time.sleep(0.001)
        return False, None

    def stop(self) -> None:
        return

    # a recording
    def load_device(self, path: str) -> Library:
        return self

    def set_real_time(self, real: bool) -> None:
        assert not real

    def set_status_changed_callback(self, changed: Callable[[str], None]) -> None:
        def play() -> None:
            while not all(sensor.callback for sensor in self.sensors if sensor.profiles):
                time.sleep(0.001)
            for frame in self.sent:
                callback = next(s.callback for s in self.sensors if frame.profile in s.profiles)
                if callback is not None:
                    callback(frame)
            changed("stopped")

        threading.Thread(target=play, daemon=True).start()
