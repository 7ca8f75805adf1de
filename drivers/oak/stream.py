"""One segment of an OAK: threads that drain depthai's queues, since an exception inside its nodes terminates Python."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import numpy as np

from stereo_sfm.drivers.live.buffers import Handoff, MotionBuffer
from stereo_sfm.drivers.live.clock import ClockMap
from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.drivers.live.errors import DeviceLost
from stereo_sfm.drivers.live.pairing import LEFT, RIGHT, CameraImage, Pair, Pairer
from stereo_sfm.drivers.oak.library import device_error

_WAIT = timedelta(milliseconds=200)
_MAX_EXPOSURE_US = 1_000_000
_ISO_PER_GAIN = 100.0


class OakStream:
    """Provides pairs in `pairs` and inertial samples in `motion` (camera clock).

    Args:
        dai: the library.
        left, right: queues of ImgFrame (GRAY8). imu: queue of IMUData, or None.
        size: (width, height) that every image must have, px.
        counters: shared with the source.
        period_ns: nominal time between frames.
        queue_frames: pairs waiting for the consumer before the oldest is discarded.
        end: called once, when streaming ends.
    """

    def __init__(
        self,
        dai: Any,
        left: Any,
        right: Any,
        imu: Any | None,
        size: tuple[int, int],
        counters: Counters,
        period_ns: int,
        queue_frames: int,
        end: Callable[[], None] = lambda: None,
    ) -> None:
        self._dai, self._size, self._counters, self._end = dai, size, counters, end
        self.pairs: Handoff[Pair] = Handoff(queue_frames)
        self.motion = MotionBuffer()
        self.clock = ClockMap()
        self._pairer = Pairer(counters, period_ns)
        self._lock = threading.Lock()  # one pairer, two queues
        self._stopping = threading.Event()
        self._last_motion = {True: -1, False: -1}
        work: list[tuple[str, Any, Callable[[Any], None]]] = [
            ("left", left, lambda frame: self._take_image(LEFT, frame)),
            ("right", right, lambda frame: self._take_image(RIGHT, frame)),
        ]
        if imu is not None:
            work.append(("imu", imu, self._take_motion))
        self._threads = [
            threading.Thread(target=self._drain, args=(queue, take), name=f"oak-{name}", daemon=True)
            for name, queue, take in work
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self, camera_alive: bool = True) -> None:
        self._stopping.set()
        self._end()
        for thread in self._threads:
            thread.join()

    def _drain(self, queue: Any, take: Callable[[Any], None]) -> None:
        """Run a thread; its error is passed to the consumer."""
        try:
            while not self._stopping.is_set():
                message = queue.get(_WAIT)
                if message is not None:
                    take(message)
        except self._dai.MessageQueue.QueueException:
            self.pairs.fail(DeviceLost("the OAK was disconnected (unplugged, or its firmware crashed)"))
        except RuntimeError as error:
            self.pairs.fail(device_error(error))
        except BaseException as error:
            self.pairs.fail(error)

    def _take_image(self, side: int, frame: Any) -> None:
        image = self._camera(frame)
        if image is None:
            self._counters.add("malformed")
            return
        with self._lock:
            if side == LEFT:
                self._map_clock(frame)
            pair = self._pairer.push(side, image)
        if pair is not None:
            self.pairs.put(pair, weight=1 + pair.dropped_before)

    def _camera(self, frame: Any) -> CameraImage | None:
        """An image at mid-exposure on the camera's clock; None if it is not an image of the requested size."""
        pixels = np.array(frame.getFrame())
        if pixels.dtype != np.uint8 or pixels.shape != (self._size[1], self._size[0]):
            return None
        exposure_us = frame.getExposureTime() / timedelta(microseconds=1)
        if not 0 <= exposure_us <= _MAX_EXPOSURE_US:
            return None
        stamp = _nanoseconds(frame.getTimestampDevice(self._dai.CameraExposureOffset.MIDDLE))
        gain = frame.getSensitivity() / _ISO_PER_GAIN
        return CameraImage(stamp, frame.getSequenceNum(), pixels, exposure_us, gain)

    def _map_clock(self, frame: Any) -> None:
        """The clock offset from an image: depthai maps its stamps to the host clock itself."""
        middle = self._dai.CameraExposureOffset.MIDDLE
        host, camera = _nanoseconds(frame.getTimestamp(middle)), _nanoseconds(frame.getTimestampDevice(middle))
        # dai.Clock is the monotonic clock on Linux; the difference corrects for it elsewhere
        shift = time.monotonic_ns() - _nanoseconds(self._dai.Clock.now())
        self.clock.add(host + shift, camera, host + shift)

    def _take_motion(self, message: Any) -> None:
        for packet in message.packets:
            for is_gyro, report in ((False, packet.acceleroMeter), (True, packet.gyroscope)):
                stamp = _nanoseconds(report.getTimestampDevice())
                if stamp > self._last_motion[is_gyro]:  # a packet repeats the slower sensor's last reading
                    self._last_motion[is_gyro] = stamp
                    self.motion.add(stamp, is_gyro, (report.x, report.y, report.z))


def _nanoseconds(time: timedelta) -> int:
    """timedelta holds microseconds."""
    return (time.days * 86_400 + time.seconds) * 1_000_000_000 + time.microseconds * 1000
