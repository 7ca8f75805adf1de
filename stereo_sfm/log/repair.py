"""Repair files that were not closed.

One mechanism, three uses: `recover` copies the complete records and appends the index, a full disk cuts the file back
and appends it, and the reader (`log.reader`) appends it in memory.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import IO

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from stereo_sfm.input_file import open_regular
from stereo_sfm.log.index import Index, Span, tail
from stereo_sfm.log.scan import build_index, check_magic, spans
from stereo_sfm.log.whole_file import WholeFile


def finish_in_place(
    path: Path, metadata: tuple[str, dict[str, str]] | None = None, *, keep_chunks: bool = False
) -> int:
    """Cut a file back to its last complete record and append the index; if needed, cut more chunks to make room for it.

    Args:
        path: the file.
        metadata: name and values of a record to add.
        keep_chunks: cut no complete chunk; without room for the index the file has none.

    Returns:
        The number of messages in the finished file.

    Raises:
        OSError: it cannot be read or cut, or an index alone is too large.
    """
    with open_regular(path) as stream:
        index = build_index(stream)
    if metadata is not None:
        index.add_metadata(*metadata)
    with path.open("r+b", buffering=0) as stream:
        while True:
            stream.seek(index.end)
            try:
                _write_all(stream.write, tail(index))  # over what follows: nobody else can take that room
                stream.truncate()
            except OSError:
                if keep_chunks:
                    stream.truncate(index.end)
                    return index.messages
                if not index.chunks:
                    raise
                index.drop_last_chunk()
                continue
            return index.messages


def _write_all(write: Callable[[bytes], int | None], data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[write(view) or 0 :]  # pyright: ignore[reportArgumentType]


def _declarations(index: Index) -> bytes:
    """Schema and channel records, to replace those of an omitted chunk; repeating them is allowed."""
    builder = RecordBuilder()
    for record in (*index.schemas.values(), *index.channels.values()):
        record.write(builder)
    return builder.end()


def recover(source: Path, target: Path, overwrite: bool = False) -> Index:
    """Copy the complete records and append the index.

    Raises:
        StereoSfmError: not an MCAP file, or an empty one; the target exists, cannot be made, or is being written.
    """
    with open_regular(source) as stream:
        check_magic(stream, source)
        found = build_index(stream)
        file = WholeFile(target, overwrite)
        try:
            _copy(stream, found, file.place)
            finish_in_place(file.place)
        except BaseException:
            file.discard()
            raise
        file.finish()
    return found


def _copy(stream: IO[bytes], found: Index, target: Path) -> None:
    bad = {span.offset for span in found.bad_chunks}
    with target.open("r+b") as out:
        out.write(MCAP0_MAGIC)
        skipping = False
        for span in spans(stream):
            if span.offset >= found.end:
                break
            if span.offset in bad and not skipping:
                out.write(_declarations(found))
            skipping = span.offset in bad or (skipping and span.opcode == Opcode.MESSAGE_INDEX)
            if not skipping:
                out.write(_read_span(stream, span))


def _read_span(stream: IO[bytes], span: Span) -> bytes:
    """A record's bytes, with its prefix."""
    stream.seek(span.offset)
    return stream.read(span.length)
