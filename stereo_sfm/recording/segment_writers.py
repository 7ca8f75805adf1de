"""The two files of a segment, each written by a thread of its own from a queue."""

from __future__ import annotations

import contextlib
import errno
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
    """A thread that writes one file of each segment. When the disk is full it waits, then goes on in the same file."""

    def __init__(self, limit: int, make_room: Callable[[], None]) -> None:
        self._queue: queue.Queue[tuple[Segment, Any] | None] = queue.Queue(limit)
        self._make_room, self._closing = make_room, threading.Event()
        self.bytes_written = 0  # of the newest segment
        self._newest: Segment | None = None
        self._segment: Segment | None = None  # that is being written: others may wait before the newest
        self._on_disk = 0  # bytes of its file
        self.problem, self.full = "", False
        self._thread = threading.Thread(target=self._work, name=type(self).__name__, daemon=True)
        self._thread.start()

    def put(self, item: object) -> bool:
        """Queue an item of the newest segment; False when the queue is full."""
        try:
            if self._newest is not None:
                self._queue.put_nowait((self._newest, item))
        except queue.Full:
            return False
        return True

    def turn(self, segment: Segment) -> None:
        """What is queued from now on belongs to another segment."""
        self._newest, self.bytes_written = segment, 0

    def _count(self, written: int) -> bool:
        """So many bytes are in the file of the segment that is being written; whether the disk has taken some now."""
        if taken := written != self._on_disk:
            self._on_disk, self.problem = written, ""
        if self._segment is self._newest:
            self.bytes_written = written
        return taken

    def close(self) -> None:
        """Nothing more comes; a full disk is tried once more."""
        self._closing.set()
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=0.5)

    def join(self, seconds: float) -> None:
        """Wait for the thread."""
        self._thread.join(seconds)

    def _work(self) -> None:
        while (queued := self._queue.get()) is not None:
            segment, item = queued
            try:
                if segment is not self._segment:
                    self._begin(segment)
                self._write(item)
            except (StereoSfmError, OSError) as error:
                self._problem_is(error)
                self._failed(item)
        with contextlib.suppress(StereoSfmError, OSError):
            self._finish()

    def _problem_is(self, error: StereoSfmError | OSError) -> None:
        self.problem, self.full = _said(error), disk_is_full(error)

    def _again(self, error: OSError) -> bool:
        """Make room and wait; False where the file cannot go on, or nobody waits any more."""
        tried = self.problem and self._closing.is_set()
        self._problem_is(error)
        if tried or error.errno not in (errno.ENOSPC, errno.EDQUOT):
            return False
        self._make_room()
        self._closing.wait(AGAIN_S)
        return True

    def _begin(self, segment: Segment) -> None:
        raise NotImplementedError

    def _write(self, item: Any) -> None:
        raise NotImplementedError

    def _failed(self, item: Any) -> None:
        raise NotImplementedError

    def _finish(self) -> None:
        raise NotImplementedError


class ImageWriter(_Writer):
    """Images of each segment; those that the disk refuses, or that find the queue full, are dropped."""

    def __init__(
        self, image_format: str, begin: Callable[[LogWriter], ImageLog], make_room: Callable[[], None]
    ) -> None:
        self._format, self._begin_log = image_format, begin
        self._file: LogWriter | None = None
        self._log: ImageLog | None = None
        self._again_s = 0.0
        super().__init__(IMAGES_WAITING, make_room)

    def _begin(self, segment: Segment) -> None:
        self._segment = segment
        self._finish()

    def _write(self, item: StereoImage) -> None:
        if self._segment is None or time.monotonic() < self._again_s:
            return
        if self._log is None:
            path, compress = _unused(self._segment.images), self._format != "raw"
            self._file = LogWriter(path, compress=compress, again=self._again)
            self._log = self._begin_log(self._file)
        assert self._file is not None
        self._log.image(encode_pair(item, self._format, decode=False))
        self._count(self._file.bytes_written)

    def _failed(self, item: Any) -> None:
        self._again_s = time.monotonic() + AGAIN_S
        if self._file is not None and self._file.closed:
            self._file = self._log = None
        self._make_room()

    def _finish(self) -> None:
        file, self._file, self._log = self._file, None, None
        if file is not None:
            file.close()


class PoseWriter(_Writer):
    """Everything but images."""

    def __init__(self, begin: Callable[[LogWriter], RunLog], make_room: Callable[[], None]) -> None:
        self._begin_log = begin
        self._file: LogWriter | None = None
        self._log: RunLog | None = None
        self._unwritten: list[object] = []  # since the newest chunk that is on disk
        super().__init__(MESSAGES_WAITING, make_room)

    def _begin(self, segment: Segment) -> None:
        self._segment, self._file = segment, None
        file = LogWriter(_unused(segment.poses), again=self._again)
        try:
            if self._log is None:
                self._log = self._begin_log(file)
            else:
                self._log.next_file(file)
        except BaseException:
            file.discard()
            raise
        self._file, self._unwritten = file, []

    def _write(self, item: object) -> None:
        if self._log is None or self._file is None:
            return  # at the end nobody waits for a disk that refuses
        if isinstance(item, Thumbnail):
            self._thumbnail(item.image)
        else:
            self._log.put(item)
        if self._count(self._file.bytes_written):
            self._unwritten = []
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
        """Write what may not be on disk into another file, until the disk takes it. Nothing where the file goes on."""
        assert self._segment is not None
        waiting = [*self._unwritten, item]
        while (self._file is None or self._file.closed) and not self._closing.is_set():
            self._make_room()
            try:
                self._begin(self._segment)
                for message in waiting:
                    self._write(message)
                return
            except (StereoSfmError, OSError) as error:
                self._problem_is(error)
            self._closing.wait(AGAIN_S)

    def _finish(self) -> None:
        if self._log is not None:
            self._log.close()


def _said(error: StereoSfmError | OSError) -> str:
    """A line for people."""
    known = from_os_error(error) if isinstance(error, OSError) else error
    return f"cannot record: {error}" if known is None else str(known)


def _unused(path: Path) -> Path:
    """The path, or the next one with b, ... z, zb, ... where files that a disk refused to extend have that name."""
    name, dot, suffix = path.name.partition(".")
    while path.exists():
        name = f"{name[:-1]}{chr(ord(name[-1]) + 1)}" if "a" < name[-1] < "z" else f"{name}b"
        path = path.with_name(name + dot + suffix)
    return path
