"""The T265 as a source: `t265`, `t265:SERIAL?exposure=8000&gain=2`."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from stereo_sfm.drivers.live.errors import DeviceError, DeviceLost
from stereo_sfm.drivers.live.source import LiveSource, Patience, with_rig
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.acquire import Access, acquire
from stereo_sfm.drivers.t265.camera import T265, Settings
from stereo_sfm.drivers.t265.firmware import load
from stereo_sfm.drivers.t265.messages import AntiFlicker
from stereo_sfm.drivers.t265.stream import Stream

if TYPE_CHECKING:
    from stereo_sfm.drivers.t265 import T265Options


class T265Source(LiveSource):
    """Live stereo images of one T265, with its inertial samples.

    Args:
        access: selection of the camera and its firmware.
        settings: exposure and streams.
        patience: timeouts.
        queue_frames: pairs that may wait for the consumer.
        stamp_at_start: the camera's stamps are of the start of the exposure.
        name: of the source.
    """

    def __init__(
        self,
        access: Access,
        settings: Settings,
        patience: Patience,
        queue_frames: int = 30,
        stamp_at_start: bool = False,
        name: str = "t265",
    ) -> None:
        super().__init__(name, "T265", m.PERIOD_NS, patience, stamp_at_start)
        self._access, self._settings, self._queue_frames = access, settings, queue_frames
        self._camera: T265 | None = acquire(access, self._counters)
        try:
            self.rig = self._camera.calibration()
        except DeviceError:
            self.close()
            raise
        self.info = self._camera.info

    def _start(self) -> Stream:
        if self._camera is None:
            self._camera = acquire(self._access, self._counters)
            if self._camera.info.serial != self.info.serial:
                raise DeviceLost(f"another T265 came back: waiting for serial {self.info.serial}")
        self._camera.configure(self._settings)
        stream = Stream(self._camera, self._counters, self._access.timing, self._queue_frames)
        stream.start()
        return stream

    def _release(self) -> None:
        camera, self._camera = self._camera, None
        if camera is not None:
            camera.link.close()

    def _reset(self) -> None:
        if self._camera is not None:
            self._camera.link.reset()


ANTI_FLICKER = {"50": AntiFlicker.HZ_50, "60": AntiFlicker.HZ_60, "off": AntiFlicker.OFF}


def settings_of(options: T265Options) -> Settings:
    """The settings sent to the camera."""
    return Settings(options.exposure, options.gain, ANTI_FLICKER[options.anti_flicker], options.imu)


def open_t265(serial: str, options: T265Options) -> T265Source:
    """Open a T265.

    Args:
        serial: of the camera, "" for the only one attached.
        options: see there.

    Raises:
        DeviceError: no camera, no permission, no firmware, ...
    """
    backend = options.backend
    if backend is None:
        from stereo_sfm.drivers.t265.usb_device import default_backend

        backend = default_backend()
    access = Access(backend, serial, functools.partial(load, options.firmware), options.allow_slow)
    patience, at_start = Patience(reconnect_s=options.reconnect), options.stamp == "start"
    name = f"t265:{serial}" if serial else "t265"
    source = T265Source(access, settings_of(options), patience, options.queue, at_start, name)
    return with_rig(source, options.rig)
