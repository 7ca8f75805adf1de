"""A live RealSense: `realsense`, `realsense:SERIAL?size=848x480&fps=30`."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import TYPE_CHECKING, Any

from stereo_sfm.drivers.live.buffers import Handoff
from stereo_sfm.drivers.live.clock import ClockMap
from stereo_sfm.drivers.live.pairing import Pair
from stereo_sfm.drivers.live.source import LiveSource, Patience, with_rig
from stereo_sfm.drivers.realsense.calibration import read_rig
from stereo_sfm.drivers.realsense.frames import Frames, profiles_of
from stereo_sfm.drivers.realsense.library import choose, device_error, find, load

if TYPE_CHECKING:
    from stereo_sfm.drivers.realsense import RealSenseOptions

_WAIT_MS = 200
_WAITING = 200  # frames of the library: 0.2 s of images and samples


class RealSenseStream:
    """One segment: a thread that drains the library's queue, and stops the pipeline at the end."""

    def __init__(self, pipeline: Any, queue: Any, frames: Frames, queue_frames: int) -> None:
        self._pipeline, self._queue, self._frames = pipeline, queue, frames
        self.pairs: Handoff[Pair] = Handoff(queue_frames)
        self.motion, self.clock = frames.motion, ClockMap()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._drain, name="realsense", daemon=True)
        self._thread.start()

    def _drain(self) -> None:
        try:
            while not self._stopping.is_set():
                there, frame = self._queue.try_wait_for_frame(_WAIT_MS)
                for pair in self._frames.take(frame) if there else []:
                    self.clock.add_arrival(time.monotonic_ns(), pair.left.stamp_ns)
                    self.pairs.put(pair, weight=1 + pair.dropped_before)
        except RuntimeError as error:
            self.pairs.fail(device_error(error))
        except BaseException as error:
            self.pairs.fail(error)

    def stop(self, camera_alive: bool = True) -> None:
        self._stopping.set()
        self._thread.join()
        with contextlib.suppress(RuntimeError):
            self._pipeline.stop()


class RealSenseSource(LiveSource):
    """Live infrared pairs of one camera, with the calibration that it reports for their size.

    Args:
        wanted: serial number, "" for the only camera.
        options: of the source.
        name: of the source.
    """

    def __init__(self, wanted: str, options: RealSenseOptions, name: str) -> None:
        self._alternate = options.emitter == "alternate"
        period_ns = round((2 if self._alternate else 1) * 1e9 / options.fps)
        super().__init__(name, "RealSense", period_ns, Patience(first_image_s=5.0, reconnect_s=options.reconnect))
        self._options, self._rs = options, load()
        self._serial = choose(find(self._rs), wanted)
        self._first: RealSenseStream | None = self._start()  # its profiles have the calibration

    def _start(self) -> RealSenseStream:
        if self._segment is None and getattr(self, "_first", None) is not None:
            first, self._first = self._first, None
            assert first is not None
            return first
        try:
            return self._stream()
        except RuntimeError as error:
            raise device_error(error) from None

    def _stream(self) -> RealSenseStream:
        rs, o = self._rs, self._options
        attached = find(rs)
        device = attached[choose(attached, self._serial)]
        config, (width, height) = rs.config(), o.size
        config.enable_device(self._serial)
        for index in (1, 2):
            config.enable_stream(rs.stream.infrared, index, width, height, rs.format.y8, o.fps)
        if o.imu and any(sensor.is_motion_sensor() for sensor in device.query_sensors()):
            for stream in (rs.stream.gyro, rs.stream.accel):
                config.enable_stream(stream, rs.format.motion_xyz32f)
        for sensor in device.query_sensors():
            if sensor.is_depth_sensor():
                self._set(sensor)
            elif sensor.supports(rs.option.global_time_enabled):
                sensor.set_option(rs.option.global_time_enabled, 0)  # one clock: the camera's
        pipeline, queue = rs.pipeline(), rs.frame_queue(_WAITING)
        started = pipeline.start(config, queue)
        found = profiles_of(rs, started.get_streams())
        name = started.get_device().get_info(rs.camera_info.name)
        if not hasattr(self, "rig"):
            self.rig = read_rig(rs, found["left"], found["right"], found.get("gyro"), name, self._serial)
        frames = Frames(rs, o.size, self._counters, self._period_ns, self._alternate)
        return RealSenseStream(pipeline, queue, frames, o.queue)

    def _set(self, sensor: Any) -> None:
        """Options of the infrared cameras, those that this model has."""
        option, o = self._rs.option, self._options
        values = [
            (option.global_time_enabled, 0.0),
            (option.emitter_enabled, float(self._alternate)),
            (option.emitter_on_off, float(self._alternate)),
            (option.enable_auto_exposure, float(o.exposure is None)),
        ]
        values += [] if o.exposure is None else [(option.exposure, float(o.exposure))]
        for name, value in values:
            if sensor.supports(name):
                sensor.set_option(name, value)

    def _release(self) -> None:
        first, self._first = getattr(self, "_first", None), None
        if first is not None:
            first.stop()


def open_realsense(wanted: str, options: RealSenseOptions) -> RealSenseSource:
    """Open a camera by its serial number, "" for the only one.

    Raises:
        DeviceError: no camera, no permission, ...
    """
    name = f"realsense:{wanted}" if wanted else "realsense"
    return with_rig(RealSenseSource(wanted, options, name), options.rig)
