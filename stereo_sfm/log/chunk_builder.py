"""The records of a chunk, each packed at once: the library packs field by field, in a third of a log's time."""

from __future__ import annotations

import struct
from itertools import chain

from mcap._chunk_builder import ChunkBuilder
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Message, MessageIndex

HEAD = struct.Struct("<BQHIQQ")  # opcode, length of the rest, channel, sequence, log time, publish time
REST_BYTES = HEAD.size - 9


class Index(MessageIndex):
    """Of the messages of one channel."""

    def write(self, stream: RecordBuilder) -> None:
        """Append the record."""
        numbers = list(chain.from_iterable(self.records))
        data = struct.pack(f"<HI{len(numbers)}Q", self.channel_id, 8 * len(numbers), *numbers)
        stream.write(struct.pack("<BQ", Opcode.MESSAGE_INDEX, len(data)) + data)


class Chunk(ChunkBuilder):
    """As the library's, with the same bytes."""

    def add_message(self, message: Message) -> None:
        """Append a message."""
        stamp = message.log_time
        first = self.num_messages == 0
        self.message_start_time = stamp if first else min(self.message_start_time, stamp)
        self.message_end_time = max(self.message_end_time, stamp)
        index = self.message_indices.get(message.channel_id)
        if index is None:
            index = self.message_indices[message.channel_id] = Index(message.channel_id, [])
        index.records.append((stamp, self.record_writer.count))
        self.num_messages += 1
        size = REST_BYTES + len(message.data)
        self.record_writer.write(
            HEAD.pack(Opcode.MESSAGE, size, message.channel_id, message.sequence, stamp, message.publish_time)
        )
        self.record_writer.write(message.data)
