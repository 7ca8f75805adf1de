"""`LogWriter` writes an MCAP file in chunks of at most 4 MiB or 0.4 s, each written at once.

So `kill -9` loses less than half a second, and a full disk leaves a properly closed file up to the last chunk
that fitted. The file is locked meanwhile; one that replaces another is written beside it.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from stereo_sfm.errors import Hindered, StereoSfmError
from stereo_sfm.log import repair, schema
from stereo_sfm.log.topics import BY_NAME
from stereo_sfm.log.whole_file import WholeFile

log = logging.getLogger("stereo_sfm")

CHUNK_BYTES = 4 << 20  # the index of the chunks stays in memory until the end
CHUNK_NS = 400_000_000


class _File:
    """An unbuffered file: what `write` has returned from survives the death of this process."""

    def __init__(self, fd: int, again: Callable[[OSError], bool] | None) -> None:
        self._fd, self._position, self._again = fd, 0, again

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        while view:
            try:
                written = os.write(self._fd, view)
            except OSError as error:
                if self._again is None or self._is_deleted() or not self._again(error):
                    raise
                continue
            self._position += written
            view = view[written:]
        return len(data)

    def _is_deleted(self) -> bool:
        return not os.fstat(self._fd).st_nlink

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Nothing is buffered."""


class _ChunkIndex:
    """The index of the chunks as the bytes that end the file, in place of the library's list of objects.

    A long run writes 150 chunks a minute, and their index stays in memory until the end.
    """

    def __init__(self) -> None:
        self._records = RecordBuilder()

    def append(self, index: ChunkIndex) -> None:
        index.write(self._records)

    def __iter__(self) -> Iterator[Self]:
        return iter((self,))

    def write(self, summary: RecordBuilder) -> None:
        """All of them, once."""
        summary.write(self._records.end())


class LogWriter:
    """Writes messages in the order they come; topics are registered when first used."""

    def __init__(
        self,
        path: Path,
        *,
        overwrite: bool = False,
        compress: bool = True,
        clock: Callable[[], int] = time.time_ns,
        again: Callable[[OSError], bool] | None = None,
    ) -> None:
        """Create the file.

        Args:
            path: the .mcap file; its folder is made.
            overwrite: replace an existing file, when this one is whole.
            compress: zstd on every chunk; pointless for raw images of a real camera when speed matters.
            clock: wall clock in nanoseconds, for `publish_time` only.
            again: asked when the disk refuses, may wait; True: go on where it refused. With it, a file that the disk
                refuses for good loses no complete chunk, and is removed where it has no message.

        Raises:
            StereoSfmError: the file exists, cannot be created, or another process is writing it.
        """
        self._whole = WholeFile(path, overwrite)
        self._file, self.path, self._keep_chunks = _File(self._whole.fd, again), path, again is not None
        self._clock = clock
        compression = CompressionType.ZSTD if compress else CompressionType.NONE
        self._mcap = Writer(self._file, chunk_size=2 * CHUNK_BYTES, compression=compression)  # pyright: ignore[reportArgumentType]
        setattr(self._mcap, "_Writer__chunk_indices", _ChunkIndex())  # noqa: B010  # no name that is checked
        self._channels: dict[str, int] = {}
        self._pending_bytes = 0
        self._pending_since: tuple[int, int] = (0, 0)  # log and publish time of the oldest message not yet written
        self.closed = False  # also after a full disk
        self._failure: StereoSfmError | None = None
        self._guarded(lambda: self._mcap.start(library="stereo-sfm"))

    @property
    def refused(self) -> bool:
        """Whether the file was closed because the disk was full."""
        return self._failure is not None

    @property
    def bytes_written(self) -> int:
        """Size of the file now."""
        return self._file.tell()

    def attach(self, name: str, data: str | bytes, media_type: str = "text/plain", log_time: int = 0) -> None:
        """A whole file inside the file. It is on disk when this returns."""
        raw = data.encode() if isinstance(data, str) else data
        self._guarded(lambda: self._mcap.add_attachment(0, log_time, name, media_type, raw))

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Key-value pairs about the whole file. They are on disk when this returns."""
        self._guarded(lambda: self._mcap.add_metadata(name, values))

    def write(self, topic: str, message: Any, log_time: int, sequence: int = 0) -> None:
        """Append one message.

        Args:
            topic: a name of `topics.TABLE`.
            message: a protobuf message, or a dataclass that `schema` turns into one.
            log_time: sensor stamp in nanoseconds.
            sequence: frame id (stored modulo 2**32).

        Raises:
            StereoSfmError: the disk is full; the file is closed and readable. A stamp that MCAP cannot hold.
        """
        if self.closed:
            raise self._failure or ValueError(f"{self.path} is closed")
        if not 0 <= log_time < 2**63:
            raise StereoSfmError(
                f"a stamp of {log_time / 1e9:g} s cannot be logged: MCAP allows times from 0 to the year 2262"
            )
        data: bytes = schema.encode(message) if is_dataclass(message) else message.SerializeToString()
        now = max(self._clock(), 0)  # a clock may stand before 1970: MCAP has no such times
        if self._pending_bytes and self._due(len(data), log_time, now):
            self.flush()
        if not self._pending_bytes:
            self._pending_since = (log_time, now)
        self._pending_bytes += len(data) + 31
        channel = self._channels.get(topic) or self._register(topic, message)
        self._guarded(lambda: self._mcap.add_message(channel, log_time, data, now, sequence & 0xFFFFFFFF))

    def flush(self) -> None:
        """Write everything so far to the file."""
        self._pending_bytes = 0
        self._guarded(self._mcap.flush)

    def close(self) -> None:
        """Write the index and close. Safe to call twice."""
        self._end(self._whole.finish)

    def _end(self, close: Callable[[], None]) -> None:
        if not self.closed:
            self._guarded(self._mcap.finish)
            self.closed = True
            close()

    def discard(self) -> None:
        """Remove it; an older file of its name stays."""
        if not self.closed:
            self.closed = True
            self._whole.discard()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        cut = error is not None and not isinstance(error, GeneratorExit)  # one that is closed is whole
        beside = cut and self._whole.beside and not self.closed
        self._end(self._whole.close if beside else self._whole.finish)
        if beside:  # an older file, which what is not whole does not replace
            log.warning("%s is as it was; what was written until the error is in %s", self.path, self._whole.place)

    def _due(self, size: int, log_time: int, now: int) -> bool:
        since_log, since_publish = self._pending_since
        return (
            self._pending_bytes + size > CHUNK_BYTES
            or log_time - since_log >= CHUNK_NS
            or now - since_publish >= CHUNK_NS
        )

    def _register(self, topic: str, message: Any) -> int:
        if is_dataclass(message):
            name, data = schema.full_name(type(message)), schema.schema_data(type(message))
        else:
            name, data = message.DESCRIPTOR.full_name, build_file_descriptor_set(type(message)).SerializeToString()
        row = BY_NAME.get(topic)
        if row is None or name not in row.schema.split("|"):
            raise ValueError(f"topic {topic} with schema {name} is not in the table of topics")
        self._pending_bytes += len(name) + len(data) + len(topic) + 64  # both records go into the chunk
        schema_id = self._mcap.register_schema(name, SchemaEncoding.Protobuf, data)
        self._channels[topic] = self._mcap.register_channel(topic, MessageEncoding.Protobuf, schema_id)
        return self._channels[topic]

    def _guarded(self, action: Callable[[], Any]) -> None:
        """Run a writing action; when the disk refuses, close the file at its last complete chunk."""
        try:
            action()
        except OSError as error:
            self.closed = True
            self._failure = Hindered(f"recording stopped, {error.strerror or error}: {self._kept()}")
            raise self._failure from None

    def _kept(self) -> str:
        """Close what the disk refused to extend; what is left of it, for people."""
        place, leave = self._whole.place, self._whole.close
        as_it_was = f"; {self.path} is as it was" if self._whole.beside else ""
        try:
            messages = repair.finish_in_place(place, keep_chunks=self._keep_chunks) if self._file.tell() else 0
            if not messages and (self._keep_chunks or not self._file.tell()):
                leave = self._whole.discard
                return f"{place} has no message and is removed{as_it_was}"
            size = place.stat().st_size / 1e6
            return f"{place} is closed and readable up to that point ({messages} messages, {size:.1f} MB){as_it_was}"
        except (OSError, StereoSfmError):  # deleted meanwhile, a device, or no room
            return f"{place} has no index{as_it_was}"
        finally:
            leave()
