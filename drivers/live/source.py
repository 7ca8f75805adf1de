"""Base of live cameras: streaming segments on one time line, restarts, counters."""

from __future__ import annotations

import logging
import time
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar

from stereo_sfm.drivers.live.buffers import Handoff, MotionBuffer, WheelBuffer
from stereo_sfm.drivers.live.clock import ClockMap, TimeLine
from stereo_sfm.drivers.live.counters import LOSSES, Counters
from stereo_sfm.drivers.live.errors import DeviceError, DeviceLost, FirmwareMissing
from stereo_sfm.drivers.live.pairing import Pair, periods
from stereo_sfm.drivers.rig_option import RigOption, chosen_rig
from stereo_sfm.drivers.source import BaseSource
from stereo_sfm.types import ImuSamples, StereoImage

logger = logging.getLogger("stereo_sfm")

_RETRY_S = 0.2
_STALL_PERIODS = 4  # without an image, at least: a slow camera that loses one has not stalled
_QUIET_S = 1.0  # between two warnings about lost frames


class Segment(Protocol):
    """A period of streaming without a restart."""

    pairs: Handoff[Pair]
    motion: MotionBuffer  # stamps of the camera's clock
    clock: ClockMap  # known when the first pair is there, and read again as the clocks drift

    def stop(self, camera_alive: bool = True) -> None:
        """Stop streaming; a responding camera gets the command."""
        ...


@dataclass(frozen=True)
class Patience:
    """Timeouts of a live source."""

    stall_s: float = 0.5  # without an image, and without several that were due: the camera has stalled
    first_image_s: float = 3.0  # likewise for the first image of a segment
    reconnect_s: float = 20.0  # searching for a lost camera


class _Stalled(DeviceLost):
    """The camera is connected but sends no images."""


class LiveSource(BaseSource):
    """Live stereo images with the camera's factory calibration.

    Failures: lost images are counted in `dropped_before` of the next one; a stalled camera is restarted, then reset; an
    unplugged camera is waited for. Each restart begins a new segment: frame ids continue, stamps continue on the first
    segment's clock. If the camera does not come back, iteration raises DeviceLost after the last image. `counters`
    (names: stereo_sfm.drivers.live.counters.COUNTERS) has the totals.

    Args:
        name: of the source.
        title: of the camera, for messages.
        period_ns: nominal time between frames.
        patience: timeouts.
        stamp_at_start: the camera's stamps are of the start of the exposure, not of its middle.
    """

    live = True

    def __init__(self, name: str, title: str, period_ns: int, patience: Patience, stamp_at_start: bool = False) -> None:
        self.name = name
        self.counters = self._counters = Counters()
        self._title, self._period_ns, self._patience = title, period_ns, patience
        self._stamp_at_start = stamp_at_start
        self._time, self._wheel = TimeLine(), WheelBuffer()
        self._segment: Segment | None = None
        self._frame_id = 0
        self._segment_frames = 0
        self._unreported, self._quiet_until = 0, 0.0
        self._summed_up = False

    # ---- implemented by each camera

    @abstractmethod
    def _start(self) -> Segment:
        """Open the camera if necessary, and start streaming.

        Raises:
            DeviceError: it failed.
        """

    @abstractmethod
    def _release(self) -> None:
        """Release the camera; it may be disconnected, or never have been open."""

    def _reset(self) -> None:
        """A stronger reset after a restart did not help, while the camera is still open."""
        return

    # ---- public interface

    def close(self) -> None:
        """Stop streaming, release the camera, and log the counters in one line."""
        self._shut(camera_alive=True)
        losses = {k: v for k, v in self.counters.items() if v and k in LOSSES}
        if self._frame_id and not self._summed_up:
            self._summed_up = True
            text = ", ".join(f"{name} {count:.0f}" for name, count in losses.items()) or "nothing lost"
            level = logging.WARNING if losses else logging.INFO
            logger.log(level, "%s: %d stereo images, %s", self._title, self._frame_id, text)

    def push_wheel(
        self, linear: tuple[float, float, float], angular: tuple[float, float, float], host_ns: int | None = None
    ) -> None:
        """Add wheel odometry to pass on with the images, body axes (x forward, y left); ignored before the first image.

        Args:
            linear: m/s. angular: rad/s.
            host_ns: `time.monotonic_ns()` of the measurement, now when None.
        """
        if self._segment is not None and self._segment_frames:
            camera_ns = self._segment.clock.to_camera(time.monotonic_ns() if host_ns is None else host_ns)
            self._wheel.add(self._time.stamp(camera_ns), linear, angular)

    def __iter__(self) -> Iterator[StereoImage]:
        if self._segment is None:
            self._begin()
        while True:
            try:
                segment, pair, lost = self._next()
            except DeviceError as error:
                self._recover(error)
            else:
                yield self._image(segment, pair, lost)

    # ---- images

    def _next(self) -> tuple[Segment, Pair, int]:
        least = self._patience.stall_s if self._segment_frames else self._patience.first_image_s
        wait = max(least, _STALL_PERIODS * self._period_ns / 1e9)
        if self._segment is None:
            raise DeviceLost(f"the {self._title} source is closed")
        got = self._segment.pairs.get(wait)
        if got is None:
            raise _Stalled(f"{self._title} sent no image for {wait * 1e3:.0f} ms")
        return self._segment, *got

    def _image(self, segment: Segment, pair: Pair, lost_here: int) -> StereoImage:
        last, first = self._time.last, self._segment_frames == 0
        if first:
            self._time.begin_segment(segment.clock)
        camera_ns = pair.left.stamp_ns
        stamp = self._time.frame_stamp(camera_ns + self._to_middle_ns(pair))
        dropped = pair.dropped_before + lost_here
        if first and last >= 0:
            dropped = max(0, periods(stamp - last, self._period_ns) - 1)
        imu, wheel = segment.motion.take(camera_ns), self._wheel.take(stamp)
        self._count(dropped, lost_here, len(imu.stamp_ns) if imu else 0, len(wheel.stamp_ns) if wheel else 0)
        image = StereoImage(
            frame_id=self._frame_id,
            stamp_ns=stamp,
            left=pair.left.pixels,
            right=pair.right.pixels,
            right_stamp_ns=stamp + pair.right.stamp_ns - camera_ns,
            exposure_us=pair.left.exposure_us,
            gain=pair.left.gain,
            dropped_before=dropped,
            imu=self._shifted(imu),
            wheel=wheel,
        )
        self._frame_id += 1
        self._segment_frames += 1
        return image

    def _to_middle_ns(self, pair: Pair) -> int:
        return round(pair.left.exposure_us * 500) if self._stamp_at_start else 0

    def _shifted(self, imu: ImuSamples | None) -> ImuSamples | None:
        shift = self._time.stamp(0)
        return imu if imu is None or shift == 0 else imu.shifted(shift)

    def _count(self, dropped: int, lost_here: int, imu: int, wheel: int) -> None:
        amounts = {"pairs": 1, "dropped": dropped, "dropped_by_host": lost_here, "imu_samples": imu}
        for name, amount in {**amounts, "wheel_samples": wheel}.items():
            self._counters.add(name, amount)
        if dropped:
            self._warn_lost(dropped, lost_here)

    def _warn_lost(self, dropped: int, lost_here: int) -> None:
        """At most one warning per second; later losses are included in the next one."""
        self._unreported += dropped
        if time.monotonic() >= self._quiet_until:
            why = " (this computer is too slow)" if lost_here else ""
            logger.warning("%s: %d frame(s) lost before frame %d%s", self._title, self._unreported, self._frame_id, why)
            self._unreported, self._quiet_until = 0, time.monotonic() + _QUIET_S

    # ---- segments

    def _begin(self) -> None:
        self._segment = self._start()
        self._segment_frames = 0
        self._counters.add("segments")

    def _shut(self, camera_alive: bool) -> None:
        segment, self._segment = self._segment, None
        if segment is not None:
            segment.stop(camera_alive)
        self._release()

    def _recover(self, error: DeviceError) -> None:
        """Restart the camera in a new segment.

        Raises:
            DeviceLost: it did not come back in time.
        """
        stalled = isinstance(error, _Stalled)
        self._counters.add("stalls" if stalled else "disconnects")
        logger.warning("%s; restarting it (frame %d)", error, self._frame_id)
        if stalled and not self._segment_frames:
            self._reset()  # a restart did not help
            stalled = False
        self._shut(camera_alive=stalled)
        deadline = time.monotonic() + self._patience.reconnect_s
        while True:
            try:
                self._begin()
            except DeviceError as again:
                self._shut(camera_alive=False)
                if time.monotonic() < deadline and not isinstance(again, FirmwareMissing):
                    time.sleep(_RETRY_S)
                    continue
                raise DeviceLost(
                    f"the {self._title} did not come back within {self._patience.reconnect_s:.0f} s: {again} "
                    f"(lost before frame {self._frame_id})"
                ) from None
            logger.warning("%s is back: segment %d", self._title, int(self.counters["segments"]))
            return


S = TypeVar("S", bound=LiveSource)


def with_rig(source: S, rig: RigOption) -> S:
    """The open source with the user's calibration, if any; closed again if that is invalid."""
    try:
        source.rig = chosen_rig(rig, lambda: source.rig)
    except BaseException:
        source.close()
        raise
    return source
