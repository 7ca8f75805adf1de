"""The T265 as a source: segments of streaming on one time line, restarts, counters.

Options (keywords, or `t265:SERIAL?exposure=8000&gain=2`): see `open_t265`.
"""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Self

from drivers.live.buffers import WheelBuffer
from drivers.live.clock import TimeLine
from drivers.live.counters import Counters
from drivers.live.errors import DeviceError, DeviceLost, FirmwareMissing
from drivers.live.options import Options
from drivers.live.pairing import Pair
from drivers.t265 import messages as m
from drivers.t265.acquire import Access, acquire
from drivers.t265.camera import MAX_EXPOSURE_US, MAX_GAIN, MIN_EXPOSURE_US, MIN_GAIN, T265, Settings
from drivers.t265.firmware import load
from drivers.t265.link import Timing
from drivers.t265.messages import AntiFlicker
from drivers.t265.stream import Stream
from stereo_sfm.types import ImuSamples, StereoImage, Trajectory

logger = logging.getLogger("stereo_sfm")

_FIRST_IMAGE_S = 3.0  # the first image of a segment may take its time
_RETRY_S = 0.2


class _Stalled(DeviceLost):
    """The camera is there but sends no images."""


class T265Source:
    """Live stereo images of one T265 with its factory calibration.

    What happens when something goes wrong: images that are lost are counted in `dropped_before` of the next one; a
    camera that stalls is restarted, then reset; one that is unplugged is waited for. Each restart begins a new
    segment: frame ids continue, stamps continue on the first segment's clock. When it does not come back, iteration
    ends after the last image (or raises when there was none). `counters` (drivers.live.counters.COUNTERS) has the sums.
    """

    frame_count: int | None = None
    live = True

    def __init__(
        self,
        access: Access,
        settings: Settings,
        queue_frames: int = 30,
        stamp_at_start: bool = False,
        name: str = "t265",
    ) -> None:
        self.name = name
        self.counters = Counters()
        self.ground_truth: Trajectory | None = None
        self._access, self._settings = access, settings
        self._queue_frames, self._stamp_at_start = queue_frames, stamp_at_start
        self._time, self._wheel = TimeLine(), WheelBuffer()
        self._stream: Stream | None = None
        self._frame_id = 0
        self._segment_frames = 0
        self._camera: T265 | None = acquire(access, self.counters)
        try:
            self.rig, self.imu_calibration = self._camera.calibration()
        except DeviceError:
            self.close()
            raise
        self.info = self._camera.info

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop streaming and give the camera back."""
        self._shut(camera_alive=True)

    def push_wheel(
        self, linear: tuple[float, float, float], angular: tuple[float, float, float], host_ns: int | None = None
    ) -> None:
        """Wheel odometry to travel with the images, body axes (x forward, y left), m/s and rad/s.

        Args:
            linear, angular: velocities.
            host_ns: `time.monotonic_ns()` of the measurement, now when None.
        """
        if self._stream is not None:
            camera_ns = self._stream.clock.to_camera(time.monotonic_ns() if host_ns is None else host_ns)
            self._wheel.add(self._time.stamp(camera_ns), linear, angular)

    def __iter__(self) -> Iterator[StereoImage]:
        if self._stream is None:
            self._begin()
        while True:
            try:
                pair, lost = self._next()
            except DeviceError as error:
                if not self._recover(error):
                    return
            else:
                yield self._image(pair, lost)

    def _next(self) -> tuple[Pair, int]:
        wait = self._access.timing.stall_s if self._segment_frames else _FIRST_IMAGE_S
        if self._stream is None:
            raise DeviceLost("the T265 source is closed")
        got = self._stream.pairs.get(wait)
        if got is None:
            raise _Stalled(f"T265 sent no image for {wait * 1e3:.0f} ms")
        return got

    def _image(self, pair: Pair, lost_here: int) -> StereoImage:
        stream = self._stream
        assert stream is not None
        camera_ns = pair.left.stamp_ns
        if self._stamp_at_start:
            camera_ns += round(pair.left.exposure_us * 500)
        last = self._time.last
        stamp = self._time.frame_stamp(camera_ns)
        dropped = pair.dropped_before + lost_here
        if not self._segment_frames and last >= 0:
            dropped = max(0, round((stamp - last) / m.PERIOD_NS) - 1)
        imu, wheel = stream.motion.take(pair.left.stamp_ns), self._wheel.take(stamp)
        self._count(dropped, lost_here, len(imu.stamp_ns) if imu else 0, len(wheel.stamp_ns) if wheel else 0)
        image = StereoImage(
            frame_id=self._frame_id,
            stamp_ns=stamp,
            left=pair.left.pixels,
            right=pair.right.pixels,
            right_stamp_ns=stamp + pair.right.stamp_ns - pair.left.stamp_ns,
            exposure_us=pair.left.exposure_us,
            gain=pair.left.gain,
            dropped_before=dropped,
            imu=self._shifted(imu),
            wheel=wheel,
        )
        self._frame_id += 1
        self._segment_frames += 1
        return image

    def _shifted(self, imu: ImuSamples | None) -> ImuSamples | None:
        shift = self._time.stamp(0)
        return imu if imu is None or shift == 0 else ImuSamples(imu.stamp_ns + shift, imu.gyro, imu.accel)

    def _count(self, dropped: int, lost_here: int, imu: int, wheel: int) -> None:
        for name, amount in (
            ("pairs", 1),
            ("dropped", dropped),
            ("dropped_by_host", lost_here),
            ("imu_samples", imu),
            ("wheel_samples", wheel),
        ):
            self.counters.add(name, amount)
        if dropped:
            why = " (this computer is too slow)" if lost_here else ""
            logger.warning("T265: %d frame(s) lost before frame %d%s", dropped, self._frame_id, why)

    # ---- life and death of segments

    def _begin(self) -> None:
        if self._camera is None:
            self._camera = acquire(self._access, self.counters)
            if self._camera.info.serial != self.info.serial:
                self._shut(camera_alive=True)
                raise DeviceLost(f"another T265 came back: waiting for serial {self.info.serial}")
        self._camera.configure(self._settings)
        stream = Stream(self._camera, self.counters, self._access.timing, self._queue_frames)
        stream.start()
        self._stream, self._segment_frames = stream, 0
        self._time.begin_segment(stream.clock)

    def _shut(self, camera_alive: bool) -> None:
        stream, camera = self._stream, self._camera
        self._stream = self._camera = None
        if stream is not None:
            stream.stop(camera_alive)
        if camera is not None:
            camera.link.close()

    def _recover(self, error: DeviceError) -> bool:
        """Bring the camera back as a new segment.

        Returns:
            False when it did not come back and the images so far must do.

        Raises:
            DeviceError: it did not come back and there never was an image.
        """
        stalled = isinstance(error, _Stalled)
        self.counters.add("stalls" if stalled else "disconnects")
        logger.warning("%s; restarting it (frame %d)", error, self._frame_id)
        if stalled and not self._segment_frames and self._camera is not None:
            self._camera.link.reset()  # it was restarted already, to no avail
            stalled = False
        self._shut(camera_alive=stalled)
        deadline = time.monotonic() + self._access.timing.reconnect_s
        while True:
            try:
                self._begin()
            except DeviceError as again:
                self._shut(camera_alive=False)
                if time.monotonic() < deadline and not isinstance(again, FirmwareMissing):
                    time.sleep(_RETRY_S)
                    continue
                if not self._frame_id:
                    raise
                logger.error("T265 did not come back: %s. Ending after %d frames", again, self._frame_id)
                return False
            logger.warning("T265 is back: segment %d", int(self.counters["segments"]))
            return True


def open_t265(rest: str = "", **options: Any) -> T265Source:
    """Open a T265.

    Args:
        rest: serial of the camera, empty for the only one attached, or "simulated" for one that needs no hardware
            (drivers.t265.simulated says which further options that has).
        **options: `exposure` ('auto' or microseconds), `gain` (with manual exposure), `anti_flicker` (50, 60, off),
            `imu` (1, 0), `firmware` (path), `allow_slow` (1: accept USB 2), `stamp` (what the camera's stamp means:
            middle or start of the exposure), `queue` (pairs that may wait), `reconnect` (seconds to wait for a lost
            camera), `backend` (a pyusb backend).

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
    queue = int(opts.number("queue", 30, 1, 100_000))
    at_start = opts.choice("stamp", "middle", {"middle": False, "start": True})
    firmware_path = opts.anything("firmware", None)
    allow_slow = opts.flag("allow_slow", False)
    reconnect_s = opts.number("reconnect", 20, 0, 86_400)
    backend = opts.anything("backend", None)
    if rest == "simulated":
        from drivers.t265.simulated.source import open_simulated

        return open_simulated(opts, settings, queue, at_start, allow_slow, reconnect_s)
    opts.finish()
    if backend is None:
        from drivers.t265.usb_device import default_backend

        backend = default_backend()
    timing = Timing(reconnect_s=reconnect_s)
    access = Access(backend, rest, functools.partial(load, firmware_path), allow_slow, timing)
    return T265Source(access, settings, queue, at_start, name=f"t265:{rest}" if rest else "t265")
