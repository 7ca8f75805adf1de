"""`LogReader`: messages of an MCAP file by topic and time, whether or not the file was closed."""

from __future__ import annotations

import io
import logging
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, Message, Schema, Statistics
from mcap.summary import Summary

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import open_regular
from stereo_sfm.log import chunks, scan
from stereo_sfm.log.chunks import PREFIX
from stereo_sfm.log.index import tail
from stereo_sfm.storage.remote import Place, Remote
from stereo_sfm.storage.stream import RangeStream
from stereo_sfm.types import I64

log = logging.getLogger("stereo_sfm")


@dataclass(frozen=True)
class Record:
    """One message as it lies in the file."""

    topic: str
    channel: Channel
    schema: Schema | None
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


@dataclass(frozen=True)
class TopicInfo:
    """One channel of the file."""

    topic: str
    schema: str  # full name, "" for none
    encoding: str
    count: int


class _Repaired:
    """The complete records of a file followed by its missing index, as one stream."""

    def __init__(self, stream: IO[bytes], end: int, tail: bytes) -> None:
        self._stream, self._end, self._tail, self._at = stream, end, tail, 0

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._end + len(self._tail)}[whence]
        self._at = base + offset
        return self._at

    def read(self, size: int = -1, /) -> bytes:
        stop = self._end + len(self._tail) if size < 0 else self._at + size
        data = b""
        if self._at < self._end:
            self._stream.seek(self._at)
            data = self._stream.read(min(stop, self._end) - self._at)
        if stop > self._end:
            data += self._tail[max(self._at - self._end, 0) : stop - self._end]
        self._at += len(data)
        return data


class LogReader:
    """Opens a file, closed or cut off. `truncated` describes its damage, "" if there is none.

    A file in a bucket is read by ranges: its index, and the chunks of the messages that are asked for.
    """

    def __init__(self, path: Place) -> None:
        """Open and read the index.

        Raises:
            StereoSfmError: no such file, or not an MCAP file.
        """
        self.path = path
        try:
            stream: Any = RangeStream(path) if isinstance(path, Remote) else open_regular(path)
        except OSError as error:
            raise StereoSfmError(f"cannot read {path}: {error.strerror}") from None
        self.truncated = ""
        self.by_time = True  # False: messages come in the order of the file, for one whose clock was set back
        self._times: dict[int, I64] | None = None
        self._stream: IO[bytes] = stream
        self._distant: RangeStream | None = stream if isinstance(stream, RangeStream) else None
        self.bytes = self._stream.seek(0, io.SEEK_END)
        try:
            scan.check_magic(self._stream, path)
            self._reader, self.summary = self._open()
        except OSError as error:
            self._stream.close()
            raise StereoSfmError(f"cannot read {path}: {error.strerror}") from None
        except BaseException:
            self._stream.close()
            raise

    def _open(self) -> tuple[SeekingReader, Summary]:
        self._bytes: Any = self._stream  # what the reader sees: the file, or the file with the index it lacks
        index_is_whole = scan.summary_is_whole(self._stream)
        self._stream.seek(0)
        try:
            reader = SeekingReader(self._stream, validate_crcs=True)
            summary = reader.get_summary() if index_is_whole else None
            if summary is not None and _complete(summary):
                return reader, summary
        except (*chunks.DAMAGE, OSError, StopIteration):  # OSError: the file is shorter than its footer
            pass
        index = scan.build_index(self._stream)
        if not index.closed:
            self.truncated = f"truncated, {index.messages} messages recovered"
        elif not index_is_whole:
            self.truncated = f"its index is damaged, {index.messages} messages recovered"
        if index.bad_chunks:
            self.truncated += f"{', ' if self.truncated else ''}{len(index.bad_chunks)} damaged chunks omitted"
        if self.truncated:
            log.warning("%s: %s ('stereo-sfm recover' writes a repaired copy)", self.path, self.truncated)
        self._bytes = _Repaired(self._stream, index.end, tail(index))
        reader = SeekingReader(self._bytes, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        return reader, summary

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    @property
    def topics(self) -> list[TopicInfo]:
        """Every channel that has messages, by name."""
        counts = self._statistics.channel_message_counts
        rows = [
            TopicInfo(c.topic, self._schema_name(c), c.message_encoding, counts.get(c.id, 0))
            for c in self.summary.channels.values()
        ]
        return sorted((row for row in rows if row.count), key=lambda row: row.topic)

    @property
    def time_range(self) -> tuple[int, int]:
        """First and last log time in nanoseconds, (0, 0) for a file without messages."""
        return self._statistics.message_start_time, self._statistics.message_end_time

    def messages(
        self, topics: Collection[str] | None = None, start: int | None = None, until: int | None = None
    ) -> Iterator[Record]:
        """Messages in the order of their log time, equal times in file order; all in file order unless `by_time`.

        Args:
            topics: names, None for all.
            start: first log time, inclusive.
            until: last log time, inclusive.

        Raises:
            StereoSfmError: a damaged chunk in a file that was closed.
        """
        channels = {i: c for i, c in self.summary.channels.items() if topics is None or c.topic in topics}
        try:
            for m in self._found(channels, start, until):
                channel = channels[m.channel_id]
                schema = self.summary.schemas[channel.schema_id] if channel.schema_id else None
                yield Record(channel.topic, channel, schema, m.log_time, m.publish_time, m.sequence, m.data)
        except chunks.DAMAGE as error:
            raise self._damaged(error) from None

    def _found(self, wanted: Collection[int], start: int | None, until: int | None) -> Iterator[Message]:
        if self.summary.chunk_indexes:
            return chunks.in_order(self.summary.chunk_indexes, self._chunk, wanted, start, until, self.by_time)
        inside = [m for m in scan.loose(self._stream) if m.channel_id in wanted]
        inside = [
            m for m in inside if (start is None or m.log_time >= start) and (until is None or m.log_time <= until)
        ]
        return iter(sorted(inside, key=lambda m: m.log_time) if self.by_time else inside)

    def _chunk(self, index: ChunkIndex) -> Chunk:
        raw = self._read(index.chunk_start_offset, index.chunk_length)
        if raw[:1] != bytes([Opcode.CHUNK]):
            raise ValueError("its index does not point to a chunk")
        return Chunk.read(ReadDataStream(io.BytesIO(raw[PREFIX:])))

    def _read(self, offset: int, length: int) -> bytes:
        """Bytes of the file.

        Raises:
            ValueError: it is not that long.
        """
        if not 0 <= offset <= offset + length <= self._bytes.seek(0, io.SEEK_END):
            raise ValueError("its index points beyond the end")
        self._bytes.seek(offset)
        return self._bytes.read(length)

    def _damaged(self, error: BaseException) -> StereoSfmError:
        said = str(error) or type(error).__name__
        return StereoSfmError(f"{self.path} is damaged ({said}): 'stereo-sfm recover' copies the undamaged part")

    def stamps(self, topic: str) -> I64:
        """Log times of a topic in ascending order, from the index alone where the file has one."""
        indexed = self._indexed_times(topic)
        if indexed is None:
            return np.array([r.log_time for r in self.messages([topic])], np.int64)
        return np.sort(np.concatenate([np.zeros(0, np.int64), *indexed]))

    def step_back_ns(self, topic: str) -> int:
        """How far the log time goes back at most from one message of a topic to the next; 0 without an index."""
        return max((int(-np.diff(times).min(initial=0)) for times in self._indexed_times(topic) or []), default=0)

    def _indexed_times(self, topic: str) -> list[I64] | None:
        """Log times of each channel of a topic in file order, None where the file has no index of its messages."""
        indexes = self.summary.chunk_indexes
        if not indexes or any(not c.message_index_offsets for c in indexes):
            return None
        ids = [c.id for c in self.summary.channels.values() if c.topic == topic]
        try:
            if self._distant is not None and not self.truncated:
                return [times for i in ids if len(times := self._read_channel_index(self._distant, i))]
            if self._times is None:
                self._times = self._read_message_indexes()
        except chunks.DAMAGE as error:
            raise self._damaged(error) from None
        return [self._times[i] for i in ids if i in self._times]

    @property
    def distant(self) -> bool:
        """Whether the file is in a bucket, so that indexes are better not read as a whole."""
        return self._distant is not None

    def span_ns(self, topic: str) -> tuple[int, int]:
        """Log times between which a topic has its messages, from the index of the chunks alone; (0, 0) without one."""
        ids = {c.id for c in self.summary.channels.values() if c.topic == topic}
        held = [c for c in self.summary.chunk_indexes if not ids.isdisjoint(c.message_index_offsets)]
        if not held:
            return 0, 0
        return min(c.message_start_time for c in held), max(c.message_end_time for c in held)

    def _read_channel_index(self, stream: RangeStream, channel: int) -> I64:
        """Log times of one channel: of all that lies behind the chunks, only its records are fetched."""
        wanted: list[tuple[int, int]] = []
        for chunk in self.summary.chunk_indexes:
            offsets = chunk.message_index_offsets
            if channel in offsets:
                end = chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length
                stop = min((at for at in offsets.values() if at > offsets[channel]), default=end)
                if not 0 <= offsets[channel] < stop <= self.bytes:
                    raise ValueError("its index points beyond the end")
                wanted.append((offsets[channel], stop - offsets[channel]))
        times = [np.zeros(0, np.int64)]
        for data in stream.ranges(wanted):
            _, _, found, size = struct.unpack_from("<BQHI", data)
            if found != channel:
                raise ValueError("its index names another channel")
            times.append(np.frombuffer(data, "<u8", size // 8, struct.calcsize("<BQHI"))[::2].astype(np.int64))
        return np.concatenate(times)

    def _read_message_indexes(self) -> dict[int, I64]:
        """Log times per channel. Behind each chunk lies a record per channel: opcode, length, channel, size, pairs."""
        found: dict[int, list[I64]] = {}
        for chunk in self.summary.chunk_indexes:
            data = self._read(chunk.chunk_start_offset + chunk.chunk_length, chunk.message_index_length)
            at = 0
            while at < len(data):
                _, length, channel_id, size = struct.unpack_from("<BQHI", data, at)
                pairs = np.frombuffer(data, "<u8", size // 8, at + struct.calcsize("<BQHI"))
                found.setdefault(channel_id, []).append(pairs[::2].astype(np.int64))
                at += PREFIX + length
        return {channel_id: np.concatenate(parts) for channel_id, parts in found.items()}

    def attachment(self, name: str) -> bytes | None:
        """The content of an attached file; None where there is none, or, with a warning, where it is damaged."""
        for entry in self.summary.attachment_indexes:
            if entry.name != name:
                continue
            try:
                raw = self._read(entry.offset, entry.length)
                crc = struct.unpack("<I", raw[-4:])[0]
                if crc and crc != zlib.crc32(raw[PREFIX:-4]):
                    raise ValueError("its checksum is wrong")
                return Attachment.read(ReadDataStream(io.BytesIO(raw[PREFIX:]))).data
            except chunks.DAMAGE as error:
                log.warning("%s: the attached %s is damaged (%s) and ignored", self.path, name, error)
        return None

    def metadata(self, name: str) -> dict[str, str]:
        """All key-value pairs recorded under a name."""
        out: dict[str, str] = {}
        try:
            for record in self._reader.iter_metadata():
                if record.name == name:
                    out.update(record.metadata)
        except chunks.DAMAGE as error:
            log.warning("%s: metadata is damaged (%s) and ignored", self.path, error)
        return out

    @property
    def _statistics(self) -> Statistics:
        assert self.summary.statistics is not None
        return self.summary.statistics

    def _schema_name(self, channel: Channel) -> str:
        return self.summary.schemas[channel.schema_id].name if channel.schema_id else ""


def _complete(summary: Summary) -> bool:
    """Whether the index is complete: other writers may omit parts of it."""
    statistics = summary.statistics
    if statistics is None or any(c.schema_id and c.schema_id not in summary.schemas for c in summary.channels.values()):
        return False
    if statistics.chunk_count != len(summary.chunk_indexes) or statistics.channel_count != len(summary.channels):
        return False
    known = summary.channels.keys()
    return all(chunk.message_index_offsets.keys() <= known for chunk in summary.chunk_indexes)
