"""The content of a chunk of an MCAP file, and the messages of many chunks in the order of time.

A chunk states how large its content is. That is checked against a limit and against what the compressed data itself
declares before anything is decompressed: a few kilobytes can expand to gigabytes.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from io import BytesIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Message, Schema

MAX_BYTES = 1 << 28  # of a chunk's content: a hundred times the usual size
MAX_RECORDS = 1_000_000  # of a chunk
PREFIX = 9  # opcode and length of a record
# Exceptions of the library's parsers on damaged data.
DAMAGE = (
    McapError,
    zstandard.ZstdError,
    RuntimeError,  # lz4
    ValueError,
    struct.error,
    EOFError,
    LookupError,
    MemoryError,
    OverflowError,
)


def content(chunk: Chunk) -> bytes:
    """The decompressed records of a chunk, their checksum verified where there is one.

    Raises:
        ValueError: larger than declared or than the limit, of an unknown compression, or damaged.
    """
    size = chunk.uncompressed_size
    if size > MAX_BYTES:
        raise ValueError(f"a chunk declares {size} bytes: more than {MAX_BYTES} are not read")
    data = _decompressed(chunk.compression, chunk.data, size)
    if len(data) != size:
        raise ValueError("a chunk does not contain as many bytes as it declares")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("the checksum of a chunk is wrong")
    return data


def _decompressed(compression: str, data: bytes, size: int) -> bytes:
    if compression == "":
        return data
    if compression == "lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    if compression != "zstd":
        raise ValueError(f"unknown compression '{compression}'")
    if zstandard.frame_content_size(data) not in (-1, size):  # the library allocates the size in the frame's header
        raise ValueError("a chunk does not contain as many bytes as it declares")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=size) if size else b""


def records(chunk: Chunk) -> Iterator[tuple[int, Schema | Channel | Message]]:
    """Each schema, channel and message of a chunk with its offset in the content.

    Raises:
        ValueError: as `content`, or more than `MAX_RECORDS`.
    """
    data = content(chunk)
    stream = ReadDataStream(BytesIO(data))
    count = 0
    while stream.count < len(data):
        at = stream.count
        opcode, length = struct.unpack("<BQ", stream.read(PREFIX))
        count += 1
        if count > MAX_RECORDS:
            raise ValueError(f"a chunk holds more than {MAX_RECORDS} records")
        if opcode == Opcode.MESSAGE:
            yield at, Message.read(stream, length)
        elif opcode == Opcode.CHANNEL:
            yield at, Channel.read(stream)
        elif opcode == Opcode.SCHEMA:
            yield at, Schema.read(stream)
        else:
            stream.read(length)


def in_order(
    chunks: Iterable[ChunkIndex],
    read: Callable[[ChunkIndex], Chunk],
    wanted: Collection[int],
    start: int | None,
    until: int | None,
    by_time: bool = True,
) -> Iterator[Message]:
    """Messages of many chunks in the order of their log time, equal times in the order of the file.

    Args:
        chunks: where they lie.
        read: gets one of them.
        wanted: channels.
        start: first log time, inclusive.
        until: last log time, inclusive.
        by_time: False: all in the order of the file.
    """
    least, most = -1 if start is None else start, (1 << 64) if until is None else until
    queue: list[tuple[int, int, int, ChunkIndex | Message]] = [
        (c.message_start_time * by_time, c.chunk_start_offset, -1, c)
        for c in chunks
        if c.message_end_time >= least and c.message_start_time <= most
        and (not c.message_index_offsets or not c.message_index_offsets.keys().isdisjoint(wanted))
    ]  # fmt: skip
    heapq.heapify(queue)
    while queue:
        _, offset, _, item = heapq.heappop(queue)
        if isinstance(item, Message):
            yield item
            continue
        for at, record in records(read(item)):
            if isinstance(record, Message) and record.channel_id in wanted and least <= record.log_time <= most:
                heapq.heappush(queue, (record.log_time * by_time, offset, at, record))
