"""librealsense's frames as images and inertial samples of one clock."""

from __future__ import annotations

import logging
import math
from typing import Any

import numpy as np

from stereo_sfm.drivers.live.buffers import MotionBuffer
from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.drivers.live.pairing import LEFT, RIGHT, CameraImage, Pair, Pairer

log = logging.getLogger("stereo_sfm")

_WRAP_US = 2**32  # the hardware clock and its metadata are microseconds of 32 bits: 71.6 minutes
_GAIN_ONE = 16.0  # librealsense's gain of an infrared camera without amplification


class Frames:
    """Pairs images, and puts inertial samples of the same clock into `motion`.

    Images with the dots of the emitter on them are left out where the camera says so. Stamps are those of the middle of
    the exposure (`sensor_timestamp`) where the camera sends them. They go on where the hardware clock begins again.

    Args:
        rs: the library. size: (width, height) that every image must have, px. counters: of the source.
        period_ns: nominal time between the pairs that are passed on. alternate: the emitter is on in every other image.
    """

    def __init__(
        self, rs: Any, size: tuple[int, int], counters: Counters, period_ns: int, alternate: bool = False
    ) -> None:
        self._rs, self._size, self._counters = rs, size, counters
        self._period_ns, self._step = period_ns, 1  # from the number of an image that is passed on to the next
        self._pairer: Pairer | None = None
        self._alternate, self._clock, self._other_clock = alternate, "", False
        self._newest_ns: int | None = None  # stamp of the hardware clock, of an image or a sample
        self.motion = MotionBuffer()

    def take(self, frame: Any) -> list[Pair]:
        """The pairs that a frame, or a set of frames, completes."""
        if frame.is_frameset():
            return [pair for one in frame.as_frameset() for pair in self.take(one)]
        if frame.is_motion_frame():
            self._take_motion(frame.as_motion_frame())
            return []
        profile = frame.get_profile()
        if profile.stream_type() != self._rs.stream.infrared or self._emitter_is_on(frame):
            return []
        if self._pairer is None:
            tells = not self._alternate or not math.isnan(self._metadata(frame, "frame_laser_power_mode", math.nan))
            self._step = 2 if self._alternate and tells else 1
            self._pairer = Pairer(self._counters, self._period_ns if tells else 0)  # else those with dots come, too
        image = self._image(frame)
        if image is None:
            self._counters.add("malformed")
            return []
        pair = self._pairer.push(LEFT if profile.stream_index() == 1 else RIGHT, image)
        return [] if pair is None else [pair]

    def _emitter_is_on(self, frame: Any) -> bool:
        return self._alternate and bool(self._metadata(frame, "frame_laser_power_mode", 0))

    def _metadata(self, frame: Any, name: str, missing: float) -> float:
        key = getattr(self._rs.frame_metadata_value, name)
        return float(frame.get_frame_metadata(key)) if frame.supports_frame_metadata(key) else missing

    def _image(self, frame: Any) -> CameraImage | None:
        pixels = np.array(np.asanyarray(frame.get_data()))
        if pixels.dtype != np.uint8 or pixels.shape != (self._size[1], self._size[0]):
            return None
        self._clock = str(frame.get_frame_timestamp_domain())
        exposure_us = self._metadata(frame, "actual_exposure", 0.0)
        gain = self._metadata(frame, "gain_level", _GAIN_ONE) / _GAIN_ONE
        number = frame.get_frame_number() // self._step
        return CameraImage(self._stamp_ns(frame), number, pixels, exposure_us, gain)

    def _stamp_ns(self, frame: Any) -> int:
        """Of the middle of the exposure: a frame's stamp is of its readout, half an exposure later."""
        readout = self._told_ns(frame)
        start = self._metadata(frame, "frame_timestamp", math.nan)
        middle = self._metadata(frame, "sensor_timestamp", math.nan)
        later_us = (middle - start + _WRAP_US / 2) % _WRAP_US - _WRAP_US / 2  # one of them may have begun again
        return readout if math.isnan(later_us) else readout + round(1e3 * later_us)

    def _told_ns(self, frame: Any) -> int:
        """The stamp of a frame; of all that one of the hardware clock may mean, the nearest to the newest."""
        stamp_ns = round(frame.get_timestamp() * 1e6)
        if frame.get_frame_timestamp_domain() == self._rs.timestamp_domain.hardware_clock:
            if self._newest_ns is not None:
                wrap_ns = 1000 * _WRAP_US
                stamp_ns += round((self._newest_ns - stamp_ns) / wrap_ns) * wrap_ns
            self._newest_ns = stamp_ns
        return stamp_ns

    def _take_motion(self, frame: Any) -> None:
        """Samples of another clock than the images' are left out, and that is said once."""
        if not self._clock:
            return
        if str(frame.get_frame_timestamp_domain()) != self._clock:
            if not self._other_clock:
                log.warning("RealSense: IMU and images are on different clocks: the IMU is left out")
            self._other_clock = True
            return
        xyz = frame.get_motion_data()
        is_gyro = frame.get_profile().stream_type() == self._rs.stream.gyro
        self.motion.add(self._told_ns(frame), is_gyro, (xyz.x, xyz.y, xyz.z))


def profiles_of(rs: Any, profiles: Any) -> dict[str, Any]:
    """The stream profiles of an infrared pair ("left", "right") and of "gyro" and "accel"."""
    names = {(rs.stream.infrared, 1): "left", (rs.stream.infrared, 2): "right"}
    names |= {(rs.stream.gyro, 0): "gyro", (rs.stream.accel, 0): "accel"}
    return {names[key]: one for one in profiles if (key := (one.stream_type(), one.stream_index())) in names}
