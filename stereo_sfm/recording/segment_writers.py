"""The two files of a segment, each written by a thread of its own from a queue."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereo_sfm.errors import StereoSfmError, disk_is_full, from_os_error
from stereo_sfm.log import foxglove, topics
from stereo_sfm.log.image_log import ImageLog
from stereo_sfm.log.images import encode_pair, encode_pixels, image_message
from stereo_sfm.log.run_log import RunLog
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.recording.segments import Segment
from stereo_sfm.types import StereoImage

IMAGES_WAITING = 24
MESSAGES_WAITING = 20_000
AGAIN_S = 1.0  # between two attempts to write to a disk that refused
THUMBNAIL_PX = 160


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A small image for the file without images."""

    image: StereoImage


class _Writer:
    """A thread that writes one file of each segment."""

    def __init__(self, limit: int) -> None:
        self._queue: queue.Queue[Any] = queue.Queue(limit)
        self.bytes_written = 0  # of the newest segment
        self._newest: Segment | None = None
        self._segment: Segment | None = None  # that is being written: others may wait before the newest
        self.problem, self.full = "", False
        self._again_s = 0.0
        self._thread = threading.Thread(target=self._work, name=type(self).__name__, daemon=True)
        self._thread.start()

    def put(self, item: object) -> bool:
        """Queue an item; False when the queue is full."""
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            return False
        return True

    def turn(self, segment: Segment) -> None:
        """What is queued from now on belongs to another segment."""
        self._newest, self.bytes_written = segment, 0
        self.put(segment)

    def _count(self, written: int) -> None:
        """So many bytes are in the file of the segment that is being written."""
        if self._segment is self._newest:
            self.bytes_written = written

    def close(self) -> None:
        """Nothing more comes."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=0.5)

    def join(self, seconds: float) -> None:
        """Wait for the thread."""
        self._thread.join(seconds)

    def _work(self) -> None:
        while (item := self._queue.get()) is not None:
            try:
                if isinstance(item, Segment):
                    self._begin(item)
                else:
                    self._write(item)
            except (StereoSfmError, OSError) as error:
                self._problem_is(error)
                self._again_s = time.monotonic() + AGAIN_S
                self._failed(item)
        with contextlib.suppress(StereoSfmError, OSError):
            self._finish()

    def _problem_is(self, error: StereoSfmError | OSError) -> None:
        self.problem, self.full = _said(error), disk_is_full(error)

    def _begin(self, segment: Segment) -> None:
        raise NotImplementedError

    def _write(self, item: Any) -> None:
        raise NotImplementedError

    def _failed(self, item: Any) -> None:
        raise NotImplementedError

    def _finish(self) -> None:
        raise NotImplementedError


class ImageWriter(_Writer):
    """Images of each segment; those that the disk refuses are dropped."""

    def __init__(self, image_format: str, begin: Callable[[LogWriter], ImageLog], refused: Callable[[], None]) -> None:
        self._format, self._begin_log, self._refused = image_format, begin, refused
        self._file: LogWriter | None = None
        self._log: ImageLog | None = None
        super().__init__(IMAGES_WAITING)

    def _begin(self, segment: Segment) -> None:
        self._finish()
        self._segment = segment

    def _write(self, item: StereoImage) -> None:
        if self._segment is None or time.monotonic() < self._again_s:
            return
        if self._log is None:
            self._file = LogWriter(_unused(self._segment.images), compress=self._format != "raw")
            self._log = self._begin_log(self._file)
        assert self._file is not None
        self._log.image(encode_pair(item, self._format, decode=False))
        self._count(self._file.bytes_written)
        self.problem = ""

    def _failed(self, item: Any) -> None:
        if self._file is not None and self._file.closed:
            self._file = self._log = None
        self._refused()

    def _finish(self) -> None:
        file, self._file, self._log = self._file, None, None
        if file is not None:
            file.close()


class PoseWriter(_Writer):
    """Everything but images. What the disk refuses is tried again, after room was made."""

    def __init__(self, begin: Callable[[LogWriter], RunLog], make_room: Callable[[], None]) -> None:
        self._begin_log, self._make_room = begin, make_room
        self._file: LogWriter | None = None
        self._log: RunLog | None = None
        self._closing = False
        self._unwritten: list[object] = []  # since the newest chunk that is on disk
        self._last_chunk: list[object] = []  # in a file that the disk refused to extend
        super().__init__(MESSAGES_WAITING)

    def close(self) -> None:
        self._closing = True
        super().close()

    def _begin(self, segment: Segment) -> None:
        self._segment = segment
        file = LogWriter(_unused(segment.poses))
        if self._log is None:
            self._log = self._begin_log(file)
        else:
            self._log.next_file(file)
        self._file, self.problem = file, ""
        self._last_chunk, self._unwritten = [], []

    def _write(self, item: object) -> None:
        if self._log is None or self._file is None:
            return  # before the first image
        before = self._file.bytes_written
        if isinstance(item, Thumbnail):
            self._thumbnail(item.image)
        else:
            self._log.put(item)
        self._count(self._file.bytes_written)
        if self._file.bytes_written != before:
            self._last_chunk, self._unwritten = self._unwritten, []
        self._unwritten.append(item)

    def _thumbnail(self, image: StereoImage) -> None:
        assert self._file is not None
        height, width = image.left.shape
        size = (THUMBNAIL_PX, max(round(height * THUMBNAIL_PX / width), 1))
        small = np.asarray(cv2.resize(image.left, size, interpolation=cv2.INTER_AREA), np.uint8)
        message = image_message(encode_pixels(small, "jpeg"), size, "jpeg", "cam0")
        stamped = foxglove.stamp(message, image.stamp_ns)
        self._file.write(topics.THUMBNAIL, stamped, image.stamp_ns, image.frame_id)

    def _failed(self, item: Any) -> None:
        """Make room and write what may not be on disk into another file, until the disk takes it."""
        waiting = [*self._last_chunk, *self._unwritten, item]
        while not self._closing:
            self._make_room()
            try:
                if self._segment is not None and (self._file is None or self._file.closed):
                    self._begin(item if isinstance(item, Segment) else self._segment)
                for message in waiting:
                    if not isinstance(message, Segment):
                        self._write(message)
                self.problem = ""
                return
            except (StereoSfmError, OSError) as error:
                self._problem_is(error)
            time.sleep(AGAIN_S)

    def _finish(self) -> None:
        if self._log is not None:
            self._log.close()


def _said(error: StereoSfmError | OSError) -> str:
    """A line for people."""
    known = from_os_error(error) if isinstance(error, OSError) else error
    return f"cannot record: {error}" if known is None else str(known)


def _unused(path: Path) -> Path:
    """The path, or one beside it where a file that the disk refused to finish has that name."""
    if not path.exists():
        return path
    stem = path.name.partition(".")[0]
    suffix = path.name[len(stem) :]
    taken = (path.with_name(f"{stem}{chr(k)}{suffix}") for k in range(ord("b"), ord("z") + 1))
    return next((other for other in taken if not other.exists()), path)
