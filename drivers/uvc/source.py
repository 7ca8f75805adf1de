"""USB cameras by OpenCV (V4L2): the frames of one or two devices, divided as those of videos are."""

from __future__ import annotations

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


class UvcSource(VideoSource):
    """Live frames, stamped by the driver's clock where it tells the time of a frame, else when they come.

    A camera that stops is opened again; frames in between are lost, and stamps go on.
    """

    live = True

    def __init__(self, place: str, options: UvcOptions) -> None:
        """Raises NotFound for a camera that cannot be opened, StereoSfmError for sizes that do not fit."""
        self._cameras = [*place.split(","), *([options.right] if options.right else [])]
        self._prepare(f"uvc:{place}", options)
        self._reconnect_s, self._last_ns, self._captures = options.reconnect, -1, list[Any]()
        try:
            self._begin()
            if self._read(self._captures, 0) is None:
                raise NotFound(f"{self.name} gives no images: does another program use it?")
        except BaseException:
            self.close()
            raise

    def _begin(self) -> None:
        self.close()
        one, (width, height) = len(self._cameras) == 1 and self.rig.right is not None, self.rig.left.size
        for camera in self._cameras:
            if not camera.isdigit() and (Path(camera).is_file() or Path(camera).is_fifo()):
                raise NotFound(f"{camera} is no USB camera (see /dev/video*): 'video:{camera}' opens a video file")
            capture = capture_of(int(camera) if camera.isdigit() else camera)
            self._captures.append(capture)
            if not capture.isOpened():
                raise NotFound(f"cannot open the USB camera {camera} (see /dev/video*; does another program use it?)")
            for wide, high in ((2 * width, height), (width, 2 * height)) if one else ((width, height),):
                capture.set(cv2.CAP_PROP_FRAME_WIDTH, wide)
                capture.set(cv2.CAP_PROP_FRAME_HEIGHT, high)
                if (capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (wide, high):
                    break
            if self._fps:
                capture.set(cv2.CAP_PROP_FPS, self._fps)

    def __iter__(self) -> Iterator[StereoImage]:
        frame_id = 0
        while True:
            image = self._read(self._captures, frame_id)
            if image is None:
                self._wait(frame_id)
                continue
            yield image
            frame_id += 1

    def _wait(self, frame_id: int) -> None:
        """Open the cameras again.

        Raises:
            DeviceLost: they did not come back in time.
        """
        log.warning("%s stopped; opening it again (frame %d)", self.name, frame_id)
        deadline = time.monotonic() + self._reconnect_s
        while True:
            try:
                return self._begin()
            except NotFound as error:
                if time.monotonic() >= deadline:
                    raise DeviceLost(f"{self.name} did not come back within {self._reconnect_s:.0f} s") from error
                time.sleep(_RETRY_S)

    def _stamp_ns(self, capture: Any, frame_id: int) -> int:
        told_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        self._last_ns = max(told_ns if told_ns > 0 else time.monotonic_ns(), self._last_ns + 1)
        return self._last_ns

    def close(self) -> None:
        while self._captures:
            self._captures.pop().release()
