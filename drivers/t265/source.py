"""The T265 as a source: `t265`, `t265:SERIAL?exposure=8000&gain=2`, `t265:simulated`; options: see `open_t265`."""

from __future__ import annotations

import functools
from typing import Any

from drivers.live.errors import DeviceError, DeviceLost
from drivers.live.options import Options
from drivers.live.source import LiveSource, Patience
from drivers.rig_option import chosen_rig
from drivers.t265 import messages as m
from drivers.t265.acquire import Access, acquire
from drivers.t265.camera import MAX_EXPOSURE_US, MAX_GAIN, MIN_EXPOSURE_US, MIN_GAIN, T265, Settings
from drivers.t265.firmware import load
from drivers.t265.messages import AntiFlicker
from drivers.t265.stream import Stream


class T265Source(LiveSource):
    """Live stereo images of one T265, with its inertial samples.

    Args:
        access: which camera, and how to get at it.
        settings: exposure and streams.
        patience: waits.
        queue_frames: pairs that may wait for the consumer.
        stamp_at_start: what the camera's stamps mean.
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
        self._camera: T265 | None = acquire(access, self.counters)
        try:
            self.rig, self.imu_calibration = self._camera.calibration()
        except DeviceError:
            self.close()
            raise
        self.info = self._camera.info

    def _start(self) -> Stream:
        if self._camera is None:
            self._camera = acquire(self._access, self.counters)
            if self._camera.info.serial != self.info.serial:
                raise DeviceLost(f"another T265 came back: waiting for serial {self.info.serial}")
        self._camera.configure(self._settings)
        stream = Stream(self._camera, self.counters, self._access.timing, self._queue_frames)
        stream.start()
        return stream

    def _release(self) -> None:
        camera, self._camera = self._camera, None
        if camera is not None:
            camera.link.close()

    def _reset(self) -> None:
        if self._camera is not None:
            self._camera.link.reset()


def open_t265(rest: str = "", **options: Any) -> T265Source:
    """Open a T265.

    Args:
        rest: serial of the camera, empty for the only one attached, or "simulated" for one that needs no hardware
            (drivers.t265.simulated.source says which further options that has).
        **options: `exposure` ('auto' or microseconds), `gain` (with manual exposure), `anti_flicker` (50, 60, off),
            `imu` (1, 0), `firmware` (path), `allow_slow` (1: accept USB 2), `stamp` (what the camera's stamp means:
            middle or start of the exposure), `queue` (pairs that may wait), `reconnect` (seconds to wait for a lost
            camera), `rig` (calibration instead of the factory's), `backend` (a pyusb backend).

    Raises:
        StereoSfmError: bad option; DeviceError: no camera, no permission, no firmware, ...
    """
    opts = Options("t265", options)
    settings = Settings(
        exposure_us=opts.microseconds("exposure", MIN_EXPOSURE_US, MAX_EXPOSURE_US),
        gain=opts.number("gain", 2.0, MIN_GAIN, MAX_GAIN),
        anti_flicker=opts.choice(
            "anti_flicker", "50", {"50": AntiFlicker.HZ_50, "60": AntiFlicker.HZ_60, "off": AntiFlicker.OFF}
        ),
        imu=opts.flag("imu", True),
    )
    patience = Patience(reconnect_s=opts.number("reconnect", 20, 0, 86_400))
    queue = int(opts.number("queue", 30, 1, 100_000))
    at_start = opts.choice("stamp", "middle", {"middle": False, "start": True})
    firmware, allow_slow = opts.anything("firmware", None), opts.flag("allow_slow", False)
    rig, backend = opts.anything("rig", None), opts.anything("backend", None)
    if rest == "simulated":
        from drivers.t265.simulated.source import open_simulated

        source: T265Source = open_simulated(opts, settings, patience, queue, allow_slow)
    else:
        opts.finish()
        if backend is None:
            from drivers.t265.usb_device import default_backend

            backend = default_backend()
        access = Access(backend, rest, functools.partial(load, firmware), allow_slow)
        source = T265Source(access, settings, patience, queue, at_start, f"t265:{rest}" if rest else "t265")
    try:
        source.rig = chosen_rig(rig, lambda: source.rig)
    except BaseException:
        source.close()
        raise
    return source
