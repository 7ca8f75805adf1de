"""A running T265: identity, calibration, settings, start and stop."""

from __future__ import annotations

import array
import time
from dataclasses import dataclass, replace

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.drivers.live.errors import Busy, DeviceFault
from stereo_sfm.drivers.t265 import calibration, protocol
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.firmware import VERSION
from stereo_sfm.drivers.t265.link import Link, Timing
from stereo_sfm.drivers.t265.messages import AntiFlicker, Id, Sensor, Status

_MAX_STALE = 16  # transfers of an earlier session that an endpoint may still hold


@dataclass(frozen=True)
class Settings:
    """Stream settings."""

    exposure_us: int | None = None  # None: automatic
    gain: float = 2.0  # with manual exposure
    anti_flicker: AntiFlicker = AntiFlicker.HZ_50  # with automatic exposure
    imu: bool = True


class T265:
    """A running camera with the interface claimed.

    Args:
        link: opened.
        counters: where retries are counted.
        timing: timeouts.

    Raises:
        DeviceError: invalid answer, other firmware, or missing calibration.
    """

    def __init__(self, link: Link, counters: Counters, timing: Timing) -> None:
        self.link, self._counters, self._timing = link, counters, timing
        self._ask(protocol.low_power(False))
        self.info = protocol.decode_device_info(self._ask(protocol.request(Id.GET_DEVICE_INFO)))
        if self.info.firmware != VERSION:
            raise DeviceFault(
                f"{link.what} runs firmware {self.info.firmware}; this driver supports {VERSION}: replug it"
            )
        if not self.info.healthy:
            raise DeviceFault(f"{link.what} (serial {self.info.serial}) reports a hardware error: replug it")
        self.link.command(protocol.request(Id.STOP))  # a crashed program may have left it streaming
        self._drain()

    def _drain(self) -> None:
        """Drain the endpoints of an earlier session: the camera stays busy until they are read."""
        buffer = array.array("B", bytes(m.VIDEO_BUFFER))
        for endpoint in (m.VIDEO_IN, m.EVENT_IN):
            for _ in range(_MAX_STALE):
                if self.link.read(endpoint, buffer, 10) == 0:
                    break

    def _ask(self, request: bytes) -> protocol.Buffer:
        """Command with the answer's status checked; repeated while the camera is busy."""
        message = int.from_bytes(request[4:6], "little")
        for _ in range(self._timing.busy_tries):
            status, payload = self.link.command(request)
            if status == Status.SUCCESS:
                return payload
            if status != Status.DEVICE_BUSY:
                raise DeviceFault(f"{self.link.what} answers {m.status_name(status)} to message {message:#06x}")
            self._counters.add("busy_retries")
            time.sleep(self._timing.busy_wait_s)
        raise Busy(f"{self.link.what} stays busy: close the program that uses it, or replug it")

    def calibration(self) -> Rig:
        """Factory calibration of the cameras and the IMU. Only while stopped.

        Raises:
            DeviceFault: missing or invalid.
        """
        if not self.info.calibrated:
            raise DeviceFault(f"{self.link.what} (serial {self.info.serial}) has lost its factory calibration")
        left, right = (
            protocol.decode_camera_intrinsics(self._ask(protocol.camera_intrinsics(s)))
            for s in (Sensor.LEFT, Sensor.RIGHT)
        )
        gyro, accel = (
            protocol.decode_motion_intrinsics(self._ask(protocol.motion_intrinsics(s)))
            for s in (Sensor.GYRO, Sensor.ACCEL)
        )
        body_T_left, body_T_right, body_T_gyro = (
            protocol.decode_extrinsics(self._ask(protocol.extrinsics(s)))
            for s in (Sensor.LEFT, Sensor.RIGHT, Sensor.GYRO)
        )
        rig = calibration.rig(left, right, body_T_left, body_T_right, self.info.product, self.info.serial)
        return replace(rig, imu=calibration.imu(body_T_left, body_T_gyro, gyro, accel))

    def configure(self, settings: Settings) -> None:
        """Exposure, streams, and the camera's own tracking off. Only while stopped."""
        auto = settings.exposure_us is None
        self._ask(protocol.exposure_mode(auto, settings.anti_flicker))
        if settings.exposure_us is not None:
            self._ask(protocol.set_exposure(settings.exposure_us, settings.gain))
        self._ask(protocol.raw_streams(self._choose_streams(settings.imu)))
        self._ask(protocol.six_dof(False))

    def _choose_streams(self, imu: bool) -> list[protocol.StreamProfile]:
        """Both cameras at 848x800, 30 Hz; gyroscope and accelerometer at their highest rate."""
        offered = protocol.decode_streams(self._ask(protocol.request(Id.GET_SUPPORTED_RAW_STREAMS)))
        chosen: list[protocol.StreamProfile] = []
        for sensor in (Sensor.LEFT, Sensor.RIGHT, *((Sensor.GYRO, Sensor.ACCEL) if imu else ())):
            fitting = [p for p in offered if p.sensor == sensor]
            if sensor in (Sensor.LEFT, Sensor.RIGHT):
                shape = (m.WIDTH, m.HEIGHT, m.WIDTH, m.PIXEL_FORMAT_Y8, m.FRAME_RATE)
                fitting = [p for p in fitting if (p.width, p.height, p.stride, p.pixel_format, p.rate_hz) == shape]
            if not fitting:
                raise DeviceFault(f"{self.link.what} does not offer the stream of sensor {sensor.name}")
            best = max(fitting, key=lambda p: p.rate_hz)
            chosen.append(
                protocol.StreamProfile(
                    best.sensor, best.width, best.height, best.pixel_format, best.stride, best.rate_hz, True
                )
            )
        return chosen

    def start(self) -> None:
        """Start streaming. The readers must be running."""
        self._ask(protocol.request(Id.START))

    def stop(self) -> None:
        """Stop streaming, ignoring errors of the camera."""
        self.link.command(protocol.request(Id.STOP))

    def time_ns(self) -> int:
        """The camera's clock."""
        return protocol.decode_time(self._ask(protocol.request(Id.GET_TIME)))

    def temperatures(self) -> list[protocol.Temperature]:
        """All temperature probes."""
        return protocol.decode_temperature(self._ask(protocol.request(Id.GET_TEMPERATURE)))
