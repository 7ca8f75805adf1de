"""USB cameras by OpenCV (V4L2): the frames of one or two devices, divided as those of videos are."""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2

from stereo_sfm.drivers.live.errors import DeviceLost, NotFound
from stereo_sfm.drivers.uvc import UvcOptions
from stereo_sfm.drivers.video.source import VideoSource, capture_of
from stereo_sfm.types import StereoImage

log = logging.getLogger("stereo_sfm")

_RETRY_S = 0.2
_PASSED = 8  # frames at most that are passed over for a pair: V4L2 keeps four of each camera
_BEHIND = 2 / 3  # of the time between two frames: cameras half of it apart do not overtake each other in turns


class _Timed:
    """A capture with the times of its frames, ms, 0 where it does not tell them."""

    def __init__(self, capture: Any) -> None:
        self.capture, self.at_ms, self.gap_ms = capture, 0.0, 0.0

    def grab(self) -> bool:
        good, before = bool(self.capture.grab()), self.at_ms
        self.at_ms = float(self.capture.get(cv2.CAP_PROP_POS_MSEC))
        self.gap_ms = self.at_ms - before
        return good

    def retrieve(self) -> tuple[bool, Any]:
        return self.capture.retrieve()


class UvcSource(VideoSource):
    """Live frames, stamped by the driver's clock where it tells the time of a frame, else when they come.

    Of two cameras, frames nearest in time are paired where their driver tells it. A camera that stops is opened again;
    frames in between are lost, and stamps go on.
    """

    live = True

    def __init__(self, place: str, options: UvcOptions) -> None:
        """Raises NotFound for a camera that cannot be opened, StereoSfmError for sizes that do not fit."""
        self._cameras = [*place.split(","), *([options.right] if options.right else [])]
        self._prepare(f"uvc:{place}", options)
        self._reconnect_s, self._last_ns, self._captures = options.reconnect, -1, list[_Timed]()
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    def _begin(self) -> None:
        """Open the cameras, and pass over the first frame of each, which may be of different moments.

        Raises:
            NotFound: one of them cannot be opened, or gives no image.
        """
        self.close()
        one, (width, height) = len(self._cameras) == 1 and self.rig.right is not None, self.rig.left.size
        for camera in self._cameras:
            if not camera.isdigit() and (Path(camera).is_file() or Path(camera).is_fifo()):
                raise NotFound(f"{camera} is no USB camera (see /dev/video*): 'video:{camera}' opens a video file")
            capture = capture_of(int(camera) if camera.isdigit() else camera)
            self._captures.append(_Timed(capture))
            if not capture.isOpened():
                raise NotFound(f"cannot open the USB camera {camera} (see /dev/video*; does another program use it?)")
            for wide, high in ((2 * width, height), (width, 2 * height)) if one else ((width, height),):
                capture.set(cv2.CAP_PROP_FRAME_WIDTH, wide)
                capture.set(cv2.CAP_PROP_FRAME_HEIGHT, high)
                if (capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (wide, high):
                    break
            if self._fps:
                capture.set(cv2.CAP_PROP_FPS, self._fps)
        backends = [one.capture.getBackendName() for one in self._captures]
        self._one_clock = backends == ["V4L2", "V4L2"]  # the kernel's; others tell the time since they were opened
        if self._read(self._captures, 0) is None:
            raise NotFound(f"{self.name} gives no images: does another program use it?")

    def __iter__(self) -> Iterator[StereoImage]:
        for frame_id in itertools.count():
            image = self._read(self._captures, frame_id)
            yield self._again(frame_id) if image is None else image

    def _again(self, frame_id: int) -> StereoImage:
        """Open the cameras again, until there is an image.

        Raises:
            DeviceLost: they did not come back in time.
        """
        log.warning("%s stopped; opening it again (frame %d)", self.name, frame_id)
        deadline = time.monotonic() + self._reconnect_s
        while True:
            try:
                self._begin()
                if (image := self._read(self._captures, frame_id)) is not None:
                    return image
                raise NotFound(f"{self.name} stopped again")
            except NotFound as error:
                if time.monotonic() >= deadline:
                    raise DeviceLost(f"{self.name} did not come back within {self._reconnect_s:.0f} s") from error
                time.sleep(_RETRY_S)

    def _grab(self, captures: list[Any]) -> bool:
        """Frames of one moment: a camera gives the oldest that waits, which is behind where the other one lost some."""
        if not super()._grab(captures):
            return False
        if not self._one_clock:
            return True
        for _ in range(_PASSED):
            behind, ahead = sorted(captures, key=lambda one: one.at_ms)
            if behind.at_ms <= 0 or ahead.at_ms - behind.at_ms <= _BEHIND * behind.gap_ms:
                return True
            if not behind.grab():
                return False
        log.warning("%s: the cameras have different clocks: their frames are paired as they come", self.name)
        self._one_clock = False
        return True

    def _stamps_ns(self, captures: list[Any], frame_id: int) -> tuple[int, int]:
        left, right = (captures[-1], captures[0]) if self._swap else (captures[0], captures[-1])
        told_ns = round(left.at_ms * 1e6)
        self._last_ns = max(told_ns if told_ns > 0 else time.monotonic_ns(), self._last_ns + 1)
        known = self._one_clock and min(left.at_ms, right.at_ms) > 0
        return self._last_ns, self._last_ns + round((right.at_ms - left.at_ms) * 1e6) if known else 0

    def close(self) -> None:
        while self._captures:
            self._captures.pop().capture.release()
