"""The index of an MCAP file (its summary section) as data, and as the bytes that close a file.

MCAP specification: mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from dataclasses import dataclass, field

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC


@dataclass(frozen=True)
class Span:
    """Where a record lies in the file."""

    opcode: int
    offset: int
    length: int  # with opcode and length bytes

    @property
    def end(self) -> int:
        return self.offset + self.length


@dataclass
class Index:
    """What a summary section is made of."""

    end: int  # of the last whole record of the data section
    closed: bool = False  # the file has its closing magic bytes
    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    chunks: list[ChunkIndex] = field(default_factory=list[ChunkIndex])
    chunk_counts: list[dict[int, int]] = field(default_factory=list[dict[int, int]])  # messages per channel, per chunk
    attachments: list[AttachmentIndex] = field(default_factory=list[AttachmentIndex])
    metadata: list[MetadataIndex] = field(default_factory=list[MetadataIndex])
    loose: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])  # (channel, log time) outside chunks
    bad_chunks: list[Span] = field(default_factory=list[Span])
    lost_message_index: bytes = b""  # of the last chunk, when it was cut off; it belongs at `end`

    @property
    def counts(self) -> dict[int, int]:
        """Messages per channel."""
        total = Counter(channel for channel, _ in self.loose)
        for counts in self.chunk_counts:
            total.update(counts)
        return dict(sorted(total.items()))

    @property
    def messages(self) -> int:
        """Messages found."""
        return sum(self.counts.values())

    @property
    def time_range(self) -> tuple[int, int]:
        """First and last log time."""
        times = [t for _, t in self.loose]
        times += [t for c in self.chunks for t in (c.message_start_time, c.message_end_time)]
        return (min(times), max(times)) if times else (0, 0)

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """A record to be written at `end`."""
        builder = RecordBuilder()
        Metadata(name, values).write(builder)
        record = builder.end()
        self.metadata.append(MetadataIndex(self.end + len(self.lost_message_index), len(record), name))
        self.lost_message_index += record

    def drop_last_chunk(self) -> None:
        """Drop the last chunk and everything after it."""
        self.end = self.chunks.pop().chunk_start_offset
        self.chunk_counts.pop()
        self.attachments = [a for a in self.attachments if a.offset < self.end]
        self.metadata = [m for m in self.metadata if m.offset < self.end]
        self.lost_message_index = b""


def tail(index: Index) -> bytes:
    """What belongs at `index.end`: lost message index, DataEnd, summary section, footer and end mark."""
    head = RecordBuilder()
    head.write(index.lost_message_index)
    DataEnd(0).write(head)
    start = index.end + head.count
    body = RecordBuilder()
    for group in (index.schemas.values(), index.channels.values(), [_statistics(index)]):
        for record in group:
            record.write(body)
    for group in (index.chunks, index.attachments, index.metadata):
        for record in group:
            record.write(body)
    data = body.end()
    crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, 0), zlib.crc32(data))
    foot = RecordBuilder()
    Footer(summary_start=start, summary_offset_start=0, summary_crc=crc).write(foot)
    return head.end() + data + foot.end() + MCAP0_MAGIC


def _statistics(index: Index) -> Statistics:
    return Statistics(
        attachment_count=len(index.attachments),
        channel_count=len(index.channels),
        channel_message_counts=index.counts,
        chunk_count=len(index.chunks),
        message_count=index.messages,
        message_end_time=index.time_range[1],
        message_start_time=index.time_range[0],
        metadata_count=len(index.metadata),
        schema_count=len(index.schemas),
    )
