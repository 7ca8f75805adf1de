"""`BagReader`: messages of a ROS bag by topic and time, through the rosbags library.

Messages of ROS 1 are converted to CDR, the encoding of ROS 2: their definitions have the same fields, but for the
sequence number of the header, which is dropped.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.records import Channel, Schema

from stereo_sfm.drivers.mcap.foreign import ForeignSource
from stereo_sfm.drivers.rosbag.checked import check_bag
from stereo_sfm.drivers.rosbag.unpacked import (
    from_zstd,
    limit_chunks,
    limit_chunks_of_mcap,
    take_unpacking,
    unpacked_files,
)
from stereo_sfm.drivers.source import Stamps
from stereo_sfm.errors import StereoSfmError, require
from stereo_sfm.input_file import NotAFile
from stereo_sfm.log.chunks import DAMAGE
from stereo_sfm.log.reader import Record, TopicInfo

if TYPE_CHECKING:
    from stereo_sfm.drivers.mcap import McapOptions

_SUFFIX_ROS_1 = ".bag"


class BagSource(ForeignSource):
    """The images of a bag, with the stamps of its inertial and wheel messages listed beside them."""

    def stamps(self) -> Stamps:
        listed = super().stamps()
        samples = self.topics.samples
        others = {t: np.array([r.log_time for r in self.reader.messages([t])], np.int64) for t in samples}
        return replace(listed, others=others)


def open_bag(place: str, options: McapOptions) -> BagSource:
    """Open a bag.

    Args:
        place: a rosbag2 folder, one of its files (.db3, .mcap), or a bag of ROS 1.
        options: a calibration that replaces the one in the bag; topics where names are ambiguous.

    Raises:
        StereoSfmError: no bag, rosbags is not installed, no images, no calibration, or images that do not fit it.
    """
    if not place:
        raise StereoSfmError("no bag given: use rosbag:FOLDER or rosbag:FILE")
    require(("rosbags",), "ros", "reading ROS bags")
    reader = BagReader(Path(place).expanduser())
    try:
        return BagSource(reader, options)
    except BaseException:
        reader.close()
        raise


class BagReader:
    """A bag of either ROS, as `stereo_sfm.drivers.mcap.recording.Recording`."""

    def __init__(self, path: Path) -> None:
        """Open and read the index.

        Raises:
            StereoSfmError: no such file, or not a readable bag.
        """
        from rosbags.typesys import Stores, get_typestore

        self.path = path
        self.by_time = True  # always
        self._ros_1 = path.suffix == _SUFFIX_ROS_1
        self._types = get_typestore(Stores.LATEST)
        self._packed = False  # each message is compressed
        with ExitStack() as opened:
            self._reader: Any = self._opened(opened)
            self._close = opened.pop_all().close
        self._channels = {c.id: self._described(c) for c in self._reader.connections}

    def _opened(self, opened: ExitStack) -> Any:
        from rosbags import rosbag1, rosbag2

        try:
            path = unpacked_files(self.path, check_bag(self.path), opened)
            limit_chunks_of_mcap()
            reader = rosbag1.Reader(path) if self._ros_1 else rosbag2.Reader(path)
            reader.open()
            opened.callback(reader.close)
            _check_index(reader)
            if self._ros_1:
                limit_chunks(reader)
            else:
                self._packed = take_unpacking(reader)
        except FileNotFoundError:
            raise StereoSfmError(f"no bag at {self.path}") from None
        except NotAFile:
            raise
        except self._damage as error:
            raise StereoSfmError(f"{self.path} cannot be read as a ROS bag: {_said(error)}") from None
        return reader

    @property
    def _damage(self) -> tuple[type[Exception], ...]:
        """What the library raises for bags that are damaged or incomplete."""
        import apsw
        from rosbags import rosbag1, rosbag2
        from rosbags.serde import SerdeError

        ours = (rosbag1.ReaderError, rosbag2.ReaderError, SerdeError, apsw.Error, sqlite3.Error, zlib.error)
        return (*DAMAGE, *ours, OSError, AssertionError, TypeError, AttributeError)

    def close(self) -> None:
        """Close the files; may be called twice."""
        self._close()

    @property
    def topics(self) -> list[TopicInfo]:
        """Every topic that has messages, by name."""
        rows: dict[str, TopicInfo] = {}
        for connection in self._reader.connections:
            known = rows[connection.topic].count if connection.topic in rows else 0
            row = TopicInfo(connection.topic, connection.msgtype, "cdr", known + connection.msgcount)
            rows[connection.topic] = row
        return sorted((row for row in rows.values() if row.count), key=lambda row: row.topic)

    @property
    def time_range(self) -> tuple[int, int]:
        """First and last log time in nanoseconds."""
        return self._reader.start_time, self._reader.end_time - 1

    def messages(
        self, topics: Collection[str] | None = None, start: int | None = None, until: int | None = None
    ) -> Iterator[Record]:
        """Messages in the order of their log time.

        Raises:
            StereoSfmError: a damaged bag.
        """
        wanted = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not wanted:
            return
        try:
            for connection, time_ns, raw in self._reader.messages(wanted, start, None if until is None else until + 1):
                _check_message(time_ns, raw)
                data = self._cdr(raw, connection.msgtype)
                if data is not None:
                    channel, schema = self._channels[connection.id]
                    yield Record(connection.topic, channel, schema, time_ns, time_ns, 0, data)
        except self._damage as error:
            raise StereoSfmError(f"{self.path} is damaged: {_said(error)}") from None

    def step_back_ns(self, topic: str) -> int:
        """0: bags are read in the order of their log times."""
        return 0

    def _cdr(self, raw: bytes, kind: str) -> bytes | None:
        """A message in CDR; None for a type of ROS 1 that ROS 2 does not have."""
        if not self._ros_1:
            return from_zstd(raw) if self._packed else bytes(raw)
        return bytes(self._types.ros1_to_cdr(raw, kind)) if kind in self._types.fielddefs else None

    @staticmethod
    def _described(connection: Any) -> tuple[Channel, Schema]:
        schema = Schema(connection.id, b"", "ros2msg", connection.msgtype)
        return Channel(connection.id, connection.topic, "cdr", {}, connection.id), schema


def _check_index(reader: Any) -> None:
    """Raises ValueError for names that are no texts, and counts and times that are no numbers."""
    if not all(isinstance(name, str) for c in reader.connections for name in (c.topic, c.msgtype)):
        raise ValueError("a name or a type of its topics is not a text")
    numbers: list[Any] = [reader.start_time, reader.end_time, *(c.msgcount for c in reader.connections)]
    if not all(isinstance(n, int) and abs(n) < 1 << 63 for n in numbers):
        raise ValueError("a count or a time of its metadata is not a number")


def _check_message(time_ns: Any, raw: Any) -> None:
    """Raises ValueError for a row of a table that holds something else: each of its fields may hold anything."""
    if not (isinstance(time_ns, int) and abs(time_ns) < 1 << 63 and isinstance(raw, bytes)):
        raise ValueError("a message without time or content")


def _said(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
