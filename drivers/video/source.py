"""Videos of two cameras: one file with both images in each frame, or two files, decoded by OpenCV (FFmpeg)."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.source import BaseSource
from stereo_sfm.drivers.video import VideoOptions
from stereo_sfm.errors import StereoSfmError, printable
from stereo_sfm.types import U8, StereoImage

log = logging.getLogger("stereo_sfm")


class VideoSource(BaseSource):
    """The frames of one or two files, with the stamps of the container."""

    def __init__(self, place: str, options: VideoOptions) -> None:
        """Raises StereoSfmError for a file that is no video, or whose size does not fit the calibration."""
        self._paths = [Path(text).expanduser() for text in (place, options.right) if text]
        self._prepare(f"video:{self._paths[0].name}", options)
        captures = [_opened(path) for path in self._paths]
        counts = [int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) for capture in captures]
        self.frame_count = min(counts) if min(counts) > 0 else None
        if self.frame_count and max(counts) > self.frame_count:
            log.warning(
                "%s: its files have %d and %d frames, which are paired from the first on: if the cameras did not begin "
                "together, cut what is too much",
                self.name, *counts,
            )  # fmt: skip
        self._read(captures, 0)  # an error before the first frame

    def _prepare(self, name: str, options: VideoOptions) -> None:
        self.name, self._fps, self._swap = name, options.fps, options.swap
        self.rig = chosen_rig(options.rig, self._no_rig)

    def _no_rig(self) -> Rig:
        raise StereoSfmError(f"{self.name} has no calibration: give one with --rig FILE")

    def __iter__(self) -> Iterator[StereoImage]:
        captures, frame_id = [_opened(path) for path in self._paths], 0
        while (image := self._read(captures, frame_id)) is not None:
            yield image
            frame_id += 1

    def _read(self, captures: list[Any], frame_id: int) -> StereoImage | None:
        """The next frame; None at the end."""
        if not self._grab(captures):
            return None
        found: list[U8] = []
        for capture in captures:
            good, pixels = capture.retrieve()
            if not good:
                return None
            grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY) if pixels.ndim == 3 else pixels
            found.append(grey.astype(np.uint8, copy=False))
        stamp_ns, right_stamp_ns = self._stamps_ns(captures, frame_id)
        left, right = self._sides(found)
        return StereoImage(frame_id, stamp_ns, left, right, right_stamp_ns=right_stamp_ns)

    def _grab(self, captures: list[Any]) -> bool:
        """The next frames; False at the end."""
        grabbed = [capture.grab() for capture in captures]  # all at once: cameras go on
        return all(grabbed)

    def _stamps_ns(self, captures: list[Any], frame_id: int) -> tuple[int, int]:
        """Of the left and the right image that were read; 0: the right one has no stamp of its own."""
        told_ns = captures[0].get(cv2.CAP_PROP_POS_MSEC) * 1e6
        return round(frame_id * 1e9 / self._fps if self._fps else told_ns), 0

    def _sides(self, found: list[U8]) -> tuple[U8, U8 | None]:
        """Left and right images of a frame (or of one of each file)."""
        width, height = self.rig.left.size
        if len(found) == 1 and self.rig.right is not None:
            rows, columns = found[0].shape
            if (columns, rows) == (2 * width, height):
                found = [found[0][:, :width], found[0][:, width:]]
            elif (columns, rows) == (width, 2 * height):
                found = [found[0][:height], found[0][height:]]
            else:
                raise StereoSfmError(
                    f"{self.name}: frames of {columns}x{rows} are neither two images of the calibration's "
                    f"{width}x{height} side by side nor one above the other: use the calibration of these images, "
                    "or give the other camera's file with '?right=FILE'"
                )
        found = [np.ascontiguousarray(pixels) for pixels in (found[::-1] if self._swap else found)]
        for pixels, camera in zip(found, (self.rig.left, self.rig.right), strict=False):
            if camera is not None and pixels.shape != (camera.height, camera.width):
                raise StereoSfmError(
                    f"{self.name}: images are {pixels.shape[1]}x{pixels.shape[0]} but the calibration is for "
                    f"{camera.width}x{camera.height}: use the calibration of these images (--rig FILE)"
                )
        return found[0], found[1] if len(found) > 1 else None


def capture_of(place: int | str, backend: int = cv2.CAP_ANY) -> cv2.VideoCapture:
    """OpenCV's reader of a video or a camera.

    Raises:
        StereoSfmError: the name is not UTF-8, at which OpenCV ends the process.
    """
    if isinstance(place, str) and place != printable(place):
        raise StereoSfmError(f"{place}: OpenCV cannot open a name that is not UTF-8: rename it")
    return cv2.VideoCapture(place, backend)


def _opened(path: Path) -> Any:
    if not path.is_file():
        raise StereoSfmError(f"no video at {path}")
    capture = capture_of(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise StereoSfmError(f"{path} is not a video that OpenCV can decode")
    return capture
