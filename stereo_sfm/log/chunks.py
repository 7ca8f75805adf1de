"""What lies in a chunk of an MCAP file, and the messages of many chunks in the order of time.

A chunk states how large its content is. That is checked against a limit and against what the compressed data itself
states before anything is decompressed: a few kilobytes can stand for gigabytes.
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

MOST_BYTES = 1 << 28  # of a chunk's content: a hundred times what writers put into one
MOST_RECORDS = 1_000_000  # of a chunk
PREFIX = 9  # opcode and length of a record
# What broken bytes raise inside the library's parsers.
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
        ValueError: larger than it states or than a chunk may be, of an unknown compression, or damaged.
    """
    size = chunk.uncompressed_size
    if size > MOST_BYTES:
        raise ValueError(f"a chunk states {size} bytes, more than {MOST_BYTES} are not read")
    data = _decompressed(chunk.compression, chunk.data, size)
    if len(data) != size:
        raise ValueError("a chunk does not hold as many bytes as it states")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("the checksum of a chunk is wrong")
    return data


def _decompressed(compression: str, data: bytes, size: int) -> bytes:
    if compression == "":
        return data
    if compression == "lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    if compression != "zstd":
        raise ValueError(f"the compression '{compression}' is not known")
    if zstandard.frame_content_size(data) not in (-1, size):  # the library allocates what the frame states
        raise ValueError("a chunk does not hold as many bytes as it states")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=size) if size else b""


def records(chunk: Chunk) -> Iterator[tuple[int, Schema | Channel | Message]]:
    """Each schema, channel and message of a chunk with its offset in the content.

    Raises:
        ValueError: as `content`, or more than `MOST_RECORDS`.
    """
    data = content(chunk)
    stream = ReadDataStream(BytesIO(data))
    count = 0
    while stream.count < len(data):
        at = stream.count
        opcode, length = struct.unpack("<BQ", stream.read(PREFIX))
        count += 1
        if count > MOST_RECORDS:
            raise ValueError(f"a chunk holds more than {MOST_RECORDS} records")
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
) -> Iterator[Message]:
    """Messages of many chunks in the order of their log time, equal times in the order of the file.

    Args:
        chunks: where they lie.
        read: gets one of them.
        wanted: channels.
        start: first log time, inclusive.
        until: last log time, inclusive.
    """
    least, most = -1 if start is None else start, (1 << 64) if until is None else until
    queue: list[tuple[int, int, int, ChunkIndex | Message]] = [
        (c.message_start_time, c.chunk_start_offset, -1, c)
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
                heapq.heappush(queue, (record.log_time, offset, at, record))
