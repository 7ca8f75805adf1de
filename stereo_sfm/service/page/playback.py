"""Play-back of recordings in the page: their thumbnails, one every two seconds, and what happened at the time."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import open_regular
from stereo_sfm.log import topics
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.scan import summary_is_whole
from stereo_sfm.recording.segments import Segment, segments

MOST = 5000  # thumbnails of a recording that are shown: nearly three hours
KEPT_SEGMENTS = 8  # whose thumbnails stay in memory: some 300 kB of a minute


def timeline(folder: Path) -> list[float]:
    """Seconds of each thumbnail since the recording's first one. A segment that is being written is not in it.

    Raises:
        StereoSfmError: a file is damaged. OSError: it cannot be read.
    """
    times = [ns for _, stamps in _segments(folder) for ns in stamps][:MOST]
    return [round((ns - times[0]) / 1e9, 1) for ns in times]


def thumbnail(folder: Path, number: int) -> bytes:
    """A thumbnail by its place in the timeline, as JPEG; empty where there is none.

    Raises:
        StereoSfmError: a file is damaged. OSError: it cannot be read.
    """
    for segment, stamps in _segments(folder):
        if 0 <= number < len(stamps):
            images = _images(*_state(segment))
            return images[number] if number < len(images) else b""
        number -= len(stamps)
    return b""


def _segments(folder: Path) -> list[tuple[Segment, tuple[int, ...]]]:
    found = [segment for segment in segments(folder) if segment.poses.is_file()]
    return [(segment, _stamps(*_state(segment))) for segment in found]


def _state(segment: Segment) -> tuple[Path, int, int]:
    """A file with what changes when it is written to."""
    about = segment.poses.stat()
    return segment.poses, about.st_size, about.st_mtime_ns


@functools.lru_cache(maxsize=10_000)
def _stamps(path: Path, size: int, written_ns: int) -> tuple[int, ...]:
    with open_regular(path) as stream:
        if not summary_is_whole(stream):
            return ()
    with LogReader(path) as reader:
        return tuple(reader.stamps(topics.THUMBNAIL).tolist())


@functools.lru_cache(maxsize=KEPT_SEGMENTS)
def _images(path: Path, size: int, written_ns: int) -> list[bytes]:
    with LogReader(path) as reader:
        return [_jpeg(record.data) for record in reader.messages([topics.THUMBNAIL])]


def _jpeg(data: bytes) -> bytes:
    message: Any = CompressedImage()
    try:
        message.ParseFromString(data)
    except ValueError as error:  # protobuf's DecodeError
        raise StereoSfmError(f"a thumbnail is damaged: {error}") from None
    return bytes(message.data) if message.format == "jpeg" else b""
