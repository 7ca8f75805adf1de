"""Files of librealsense's recorder (.bag), played back by librealsense, frame by frame and without losses."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.drivers.live.pairing import Pair
from stereo_sfm.drivers.realsense.calibration import read_rig
from stereo_sfm.drivers.realsense.frames import Frames, profiles_of
from stereo_sfm.drivers.realsense.library import device_error, load
from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.source import BaseSource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import StereoImage

if TYPE_CHECKING:
    from stereo_sfm.drivers.realsense import RealSenseOptions

_WAITING = 64  # frames handed over at most: the playback waits for them to be taken
_WAIT_S = 0.2


class RealSenseRecording(BaseSource):
    """The infrared pairs and inertial samples of a recording, in the order of the file."""

    def __init__(self, path: Path, options: RealSenseOptions) -> None:
        self.name, self._path, self._rs = f"realsense:{path.name}", path, load()
        if not path.is_file():
            raise StereoSfmError(f"no recording at {path}")
        self._imu = options.imu
        device, found = self._device()
        if "left" not in found or "right" not in found:
            raise StereoSfmError(
                f"{path} has no infrared pair (streams: {', '.join(sorted(found)) or 'others'}): record both infrared "
                "streams, with the emitter off"
            )
        info = self._rs.camera_info
        name, serial = device.get_info(info.name), device.get_info(info.serial_number)
        left, right = found["left"], found["right"]
        own = read_rig(self._rs, left, right, found.get("gyro") if options.imu else None, name, serial)
        self.rig = chosen_rig(options.rig, lambda: own)
        self._rate_hz = max(left.fps(), 1)
        self._alternate = options.emitter == "alternate"

    def _device(self) -> tuple[Any, dict[str, Any]]:
        """The playback device of the file, from its beginning, and the profiles of its streams."""
        try:
            device = self._rs.context().load_device(str(self._path))
            device.set_real_time(False)
            streams = [one for sensor in device.query_sensors() for one in sensor.get_stream_profiles()]
        except RuntimeError as error:
            raise StereoSfmError(f"{self._path} is no recording of librealsense: {device_error(error)}") from None
        return device, profiles_of(self._rs, streams)

    def __iter__(self) -> Iterator[StereoImage]:
        device, _ = self._device()
        period_ns = round((2 if self._alternate else 1) * 1e9 / self._rate_hz)
        frames = Frames(self._rs, self.rig.left.size, Counters(), period_ns, self._alternate)
        waiting: queue.Queue[Any] = queue.Queue(_WAITING)
        ended, abandoned = threading.Event(), threading.Event()

        def hand_over(frame: Any) -> None:
            while not abandoned.is_set():
                with suppress(queue.Full):
                    waiting.put(frame, timeout=_WAIT_S)
                    return

        def changed(status: Any) -> None:
            if status == self._rs.playback_status.stopped:
                ended.set()

        device.set_status_changed_callback(changed)
        sensors: list[Any] = []
        wanted = {"left", "right", *(("gyro", "accel") if self._imu else ())}
        try:
            for sensor in device.query_sensors():
                mine = profiles_of(self._rs, sensor.get_stream_profiles())
                if chosen := [profile for name, profile in mine.items() if name in wanted]:
                    sensor.open(chosen)
                    sensor.start(hand_over)
                    sensors.append(sensor)
            yield from _images(frames, waiting, ended)
        except RuntimeError as error:
            raise device_error(error) from None
        finally:
            abandoned.set()
            for sensor in sensors:
                sensor.stop()
                sensor.close()


def _images(frames: Frames, waiting: queue.Queue[Any], ended: threading.Event) -> Iterator[StereoImage]:
    frame_id = 0
    while True:
        over = ended.is_set()  # before the queue is found empty: what came before the end is in it
        try:
            taken = frames.take(waiting.get(timeout=0.0 if over else _WAIT_S) if not over else waiting.get_nowait())
        except queue.Empty:
            if over:
                return
            continue
        for pair in taken:
            yield _image(frame_id, pair, frames)
            frame_id += 1


def _image(frame_id: int, pair: Pair, frames: Frames) -> StereoImage:
    left, right = pair.left, pair.right
    return StereoImage(
        frame_id, left.stamp_ns, left.pixels, right.pixels, right_stamp_ns=right.stamp_ns,
        exposure_us=left.exposure_us, gain=left.gain, dropped_before=pair.dropped_before,
        imu=frames.motion.take(left.stamp_ns),
    )  # fmt: skip


def open_recording(path: Path, options: RealSenseOptions) -> RealSenseRecording:
    """Open a file.

    Raises:
        StereoSfmError: no such file, or not one of an infrared pair.
    """
    return RealSenseRecording(path, options)
