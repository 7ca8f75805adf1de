"""One segment of streaming: a reader thread per endpoint, and one that reads the camera's clock."""

from __future__ import annotations

import array
import contextlib
import logging
import threading
import time
from collections.abc import Callable

from stereo_sfm.drivers.live.buffers import Handoff, MotionBuffer
from stereo_sfm.drivers.live.clock import ClockMap
from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.drivers.live.errors import DeviceError
from stereo_sfm.drivers.live.pairing import LEFT, RIGHT, CameraImage, Pair, Pairer
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265 import protocol, samples
from stereo_sfm.drivers.t265.camera import T265
from stereo_sfm.drivers.t265.link import Timing
from stereo_sfm.drivers.t265.messages import Sensor, Status

logger = logging.getLogger("stereo_sfm")

_CLOCK_TRIES = 3
_TEMPERATURE_S = 10.0
_STOP_S = 0.5  # waiting for the camera to confirm the stop


class Stream:
    """Streaming from `start` to `stop`, with pairs in `pairs` and inertial samples in `motion` (camera clock).

    Args:
        camera: configured and stopped.
        counters: shared with the source.
        timing: timeouts.
        queue_frames: pairs waiting for the consumer before the oldest is discarded.
    """

    def __init__(self, camera: T265, counters: Counters, timing: Timing, queue_frames: int) -> None:
        self._camera, self._counters, self._timing = camera, counters, timing
        self.pairs: Handoff[Pair] = Handoff(queue_frames)
        self.motion = MotionBuffer()
        self.clock = ClockMap()
        self._goodbye = threading.Event()  # STOP was sent: DEVICE_STOPPED ends a reader
        self._stopping = threading.Event()  # readers end now
        self._stopped = (threading.Event(), threading.Event())  # confirmed by the camera: video, events
        self._pairer: Pairer | None = None
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Start the clock, the readers, and the stream, in this order.

        Raises:
            DeviceError: start failed, everything is stopped.
        """
        self._read_clock()
        self._pairer = Pairer(self._counters, m.PERIOD_NS, now_ns=self._camera.time_ns())
        for name, work in (("video", self._read_video), ("events", self._read_events), ("clock", self._keep_clock)):
            thread = threading.Thread(target=self._guard, args=(work,), name=f"t265-{name}", daemon=True)
            self._threads.append(thread)
            thread.start()
        try:
            self._camera.start()
        except DeviceError:
            self._join()
            raise

    def stop(self, camera_alive: bool = True) -> None:
        """Stop streaming and the threads. A responding camera gets the command and some time to confirm."""
        if camera_alive:
            for stopped in self._stopped:
                stopped.clear()
            self._goodbye.set()
            with contextlib.suppress(DeviceError):
                self._camera.stop()
                for stopped in self._stopped:
                    stopped.wait(_STOP_S)
        self._join()

    def _join(self) -> None:
        self._stopping.set()
        for thread in self._threads:
            thread.join()

    def _guard(self, work: Callable[[], None]) -> None:
        """Run a thread; its error is passed to the consumer."""
        try:
            work()
        except BaseException as error:
            self.pairs.fail(error)

    def _ended(self, stopped: threading.Event) -> bool:
        return self._stopping.is_set() or (self._goodbye.is_set() and stopped.is_set())

    def _read_video(self) -> None:
        buffer = array.array("B", bytes(m.VIDEO_BUFFER))
        while not self._ended(self._stopped[0]):
            size = self._camera.link.read(m.VIDEO_IN, buffer, self._timing.read_ms)
            if size and self._take_video(memoryview(buffer)[:size]):
                buffer = array.array("B", bytes(m.VIDEO_BUFFER))  # the image keeps the previous buffer

    def _take_video(self, data: memoryview) -> bool:
        """Whether the transfer was an image."""
        try:
            message = samples.decode_video_endpoint(data)
        except protocol.ProtocolError as error:
            self._counters.add("malformed" if len(data) == m.VIDEO_BYTES else "half_frames")
            logger.debug("T265: %s", error)
            return False
        if isinstance(message, samples.StatusEvent):
            self._take_status(message, self._stopped[0])
            return False
        side = LEFT if message.sensor == Sensor.LEFT else RIGHT
        image = CameraImage(
            message.stamp_ns, message.frame_id, message.pixels, float(message.exposure_us), message.gain
        )
        pair = self._pairer.push(side, image) if self._pairer else None
        if pair is not None:
            self.pairs.put(pair, weight=1 + pair.dropped_before)
        return True

    def _read_events(self) -> None:
        buffer = array.array("B", bytes(m.EVENT_BUFFER))
        while not self._ended(self._stopped[1]):
            size = self._camera.link.read(m.EVENT_IN, buffer, self._timing.read_ms)
            if not size:
                continue
            events, damaged = samples.decode_events(memoryview(buffer)[:size])
            if damaged:
                self._counters.add("malformed", damaged)
            for event in events:
                if isinstance(event, samples.MotionSample):
                    self.motion.add(event.stamp_ns, event.sensor == Sensor.GYRO, event.xyz)
                else:
                    self._take_status(event, self._stopped[1])

    def _take_status(self, event: samples.StatusEvent, stopped: threading.Event) -> None:
        """DEVICE_STOPPED matters only while stopping: a stale one can arrive right after a start."""
        if event.status == Status.DEVICE_STOPPED:
            stopped.set()
        elif event.status != Status.SUCCESS:
            self._counters.add("camera_errors")
            logger.warning("T265 reports %s", m.status_name(event.status))

    def _keep_clock(self) -> None:
        next_temperature = 0.0
        while not self._stopping.wait(self._timing.clock_s):
            with contextlib.suppress(DeviceError):  # the readers detect a lost camera
                self._read_clock()
                if time.monotonic() >= next_temperature:
                    next_temperature = time.monotonic() + _TEMPERATURE_S
                    self._read_temperature()

    def _read_clock(self) -> None:
        for _ in range(_CLOCK_TRIES):
            before = time.monotonic_ns()
            camera_ns = self._camera.time_ns()
            if self.clock.add(before, camera_ns, time.monotonic_ns()):
                break
        self._counters["clock_uncertainty_us"] = self.clock.uncertainty_ns / 1e3

    def _read_temperature(self) -> None:
        for probe in self._camera.temperatures():
            if probe.index == 0:
                self._counters["temperature_c"] = probe.celsius
                if probe.threshold > 0 and probe.celsius > probe.threshold:
                    logger.warning(
                        "T265 is hot, %.0f of %.0f degrees Celsius, and may stop: let air reach it",
                        probe.celsius,
                        probe.threshold,
                    )
