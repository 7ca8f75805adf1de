"""Read an MCAP file record by record, however it ended, and make its index.

Checksums are verified; damaged chunks are listed.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
)
from mcap.writer import MCAP0_MAGIC

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import open_regular
from stereo_sfm.log.chunks import DAMAGE, MAX_BYTES, PREFIX, records
from stereo_sfm.log.index import Index, Span
from stereo_sfm.storage.remote import Place

FOOTER_SIZE = PREFIX + 20
_LAST_OPCODE = 0x0F
MOST_RECORD = MAX_BYTES + (1 << 16)  # bytes of a record that is read as a whole; so of the index
_OF_A_SUMMARY = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.STATISTICS,
    Opcode.SUMMARY_OFFSET,
)


def check_magic(stream: IO[bytes], path: Place) -> None:
    """Raises StereoSfmError if the file is not an MCAP file."""
    stream.seek(0)
    start = stream.read(len(MCAP0_MAGIC))
    if not start:
        raise StereoSfmError(f"{path} is empty: nothing was recorded")
    if start != MCAP0_MAGIC:
        raise StereoSfmError(f"{path} is not an MCAP file")


def spans(stream: IO[bytes], start: int = len(MCAP0_MAGIC)) -> Iterator[Span]:
    """Complete records from `start` on, up to the first damaged one."""
    size = stream.seek(0, 2)
    offset = start
    while offset + PREFIX <= size:
        stream.seek(offset)
        opcode, length = struct.unpack("<BQ", stream.read(PREFIX))
        end = offset + PREFIX + length
        if end > size or not (1 <= opcode <= _LAST_OPCODE or opcode >= 0x80):
            return
        yield Span(opcode, offset, PREFIX + length)
        offset = end


def _content(stream: IO[bytes], span: Span) -> ReadDataStream:
    """Raises ValueError for a record larger than any chunk: a file may have holes that take no disk."""
    if span.length > MOST_RECORD:
        raise ValueError(f"a record has {span.length} bytes: more than {MOST_RECORD} are not read")
    stream.seek(span.offset + PREFIX)
    return ReadDataStream(BytesIO(stream.read(span.length - PREFIX)))


def build_index(stream: IO[bytes]) -> Index:
    """Read every record of the data section. Chunks whose checksum is wrong are listed in `bad_chunks` and omitted."""
    index = Index(end=len(MCAP0_MAGIC))
    index.schemas, index.channels = _listed_at_the_end(stream)
    for span in spans(stream):
        if span.opcode in (Opcode.DATA_END, Opcode.FOOTER):
            index.closed = _ends_well(stream)
            break
        try:
            _add_record(index, stream, span)
        except DAMAGE:
            if span.opcode != Opcode.CHUNK:
                break
            index.bad_chunks.append(span)
        index.end = span.end
    if not index.closed and index.chunks:
        _repair_last_message_index(index, stream)
    return index


def _repair_last_message_index(index: Index, stream: IO[bytes]) -> None:
    """The records that index the messages of the last chunk may be missing or cut off: recreate them."""
    chunk = index.chunks[-1]
    if chunk.message_index_offsets.keys() == index.chunk_counts[-1].keys():
        return
    chunk_end = chunk.chunk_start_offset + chunk.chunk_length
    if index.end != chunk_end + chunk.message_index_length:
        return  # something else was written behind it
    span = Span(Opcode.CHUNK, chunk.chunk_start_offset, chunk.chunk_length)
    builder = RecordBuilder()
    tables: dict[int, MessageIndex] = {}
    for offset, record in records(Chunk.read(_content(stream, span))):
        if isinstance(record, Message):
            table = tables.setdefault(record.channel_id, MessageIndex(channel_id=record.channel_id, records=[]))
            table.records.append((record.log_time, offset))
    chunk.message_index_offsets.clear()
    for channel_id, table in tables.items():
        chunk.message_index_offsets[channel_id] = chunk_end + builder.count
        table.write(builder)
    chunk.message_index_length = builder.count
    index.end = chunk_end
    index.lost_message_index = builder.end()


def _listed_at_the_end(stream: IO[bytes]) -> tuple[dict[int, Schema], dict[int, Channel]]:
    """Schemas and channels of the summary section, if there is one: the chunk that first held them may be damaged."""
    try:
        if not summary_is_whole(stream):
            return {}, {}
        stream.seek(0)
        summary = SeekingReader(stream).get_summary()
    except (*DAMAGE, OSError, StopIteration):
        return {}, {}
    return (dict(summary.schemas), dict(summary.channels)) if summary is not None else ({}, {})


def summary_is_whole(stream: IO[bytes]) -> bool:
    """Whether the checksum of the summary section holds; True as well for a writer that made none.

    The checksum covers the section and the footer up to itself.
    """
    size = stream.seek(0, 2)
    footer_at = size - len(MCAP0_MAGIC) - FOOTER_SIZE
    if footer_at < len(MCAP0_MAGIC):
        return False
    stream.seek(footer_at)
    footer = stream.read(FOOTER_SIZE)
    opcode, length, start, _, crc = struct.unpack("<BQQQI", footer)
    if opcode != Opcode.FOOTER or length != FOOTER_SIZE - PREFIX or not 0 <= start <= footer_at:
        return False
    if start and footer_at - start > MOST_RECORD:
        return False
    if start and any(span.opcode not in _OF_A_SUMMARY for span in spans(stream, start) if span.end <= footer_at):
        return False
    stream.seek(start)
    return crc == 0 or start == 0 or zlib.crc32(footer[:-4], zlib.crc32(stream.read(footer_at - start))) == crc


def loose(stream: IO[bytes]) -> Iterator[Message]:
    """Messages outside chunks in the order of the file."""
    for span in spans(stream):
        if span.opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        if span.opcode == Opcode.MESSAGE:
            yield Message.read(_content(stream, span), span.length - PREFIX)


def is_closed(path: Path) -> bool:
    """Whether a file of this package has its index and end."""
    if path.stat().st_size < 2 * len(MCAP0_MAGIC):
        return False
    with open_regular(path) as stream:
        return _ends_well(stream)


def _ends_well(stream: IO[bytes]) -> bool:
    stream.seek(-len(MCAP0_MAGIC), 2)
    return stream.read() == MCAP0_MAGIC


def _add_record(index: Index, stream: IO[bytes], span: Span) -> None:
    if span.opcode == Opcode.CHUNK:
        _add_chunk(index, Chunk.read(_content(stream, span)), span)
    elif span.opcode == Opcode.SCHEMA:
        schema = Schema.read(_content(stream, span))
        index.schemas[schema.id] = schema
    elif span.opcode == Opcode.CHANNEL:
        channel = Channel.read(_content(stream, span))
        index.channels[channel.id] = channel
    elif span.opcode == Opcode.MESSAGE:
        message = Message.read(_content(stream, span), span.length - PREFIX)
        index.loose.append((message.channel_id, message.log_time))
    elif span.opcode == Opcode.MESSAGE_INDEX:
        _add_message_index(index, MessageIndex.read(_content(stream, span)), span)
    elif span.opcode == Opcode.ATTACHMENT:
        a = Attachment.read(_content(stream, span))
        index.attachments.append(
            AttachmentIndex(span.offset, span.length, a.log_time, a.create_time, len(a.data), a.name, a.media_type)
        )
    elif span.opcode == Opcode.METADATA:
        index.metadata.append(MetadataIndex(span.offset, span.length, Metadata.read(_content(stream, span)).name))


def _add_chunk(index: Index, chunk: Chunk, span: Span) -> None:
    counts: dict[int, int] = {}
    for _, record in records(chunk):
        if isinstance(record, Schema):
            index.schemas[record.id] = record
        elif isinstance(record, Channel):
            index.channels[record.id] = record
        else:
            if record.channel_id not in index.channels:
                raise ValueError(f"channel {record.channel_id} is not declared")
            counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
    index.chunk_counts.append(counts)
    index.chunks.append(
        ChunkIndex(
            chunk_length=span.length,
            chunk_start_offset=span.offset,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )
    )


def _add_message_index(index: Index, record: MessageIndex, span: Span) -> None:
    if index.chunks and record.channel_id in index.channels:
        chunk = index.chunks[-1]
        chunk.message_index_offsets[record.channel_id] = span.offset
        chunk.message_index_length += span.length
