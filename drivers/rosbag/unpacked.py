"""The content of compressed chunks and messages up to a limit, in place of the library's own, which has none."""

from __future__ import annotations

import bz2
from collections.abc import Callable
from typing import Any

import lz4.frame
import zstandard

from stereo_sfm.log.chunks import MAX_BYTES


def _from_bz2(data: bytes) -> bytes:
    return _within(bz2.BZ2Decompressor().decompress(data, MAX_BYTES + 1))


def _from_lz4(data: bytes) -> bytes:
    return _within(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=MAX_BYTES + 1))


def from_zstd(data: bytes) -> bytes:
    """A frame's content.

    Raises:
        ValueError: it is larger than `MAX_BYTES`. ZstdError: it is damaged.
    """
    if zstandard.frame_content_size(data) > MAX_BYTES:  # the decompressor allocates what the frame states
        raise _too_large()
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=MAX_BYTES)


def _within(content: bytes) -> bytes:
    if len(content) > MAX_BYTES:
        raise _too_large()
    return content


def _too_large() -> ValueError:
    return ValueError(f"a compressed part has more than {MAX_BYTES} bytes")


_LIMITED: dict[Any, Callable[[bytes], bytes]] = {bz2.decompress: _from_bz2, lz4.frame.decompress: _from_lz4}


def limit_chunks(reader: Any) -> None:
    """Let an open reader of a ROS 1 bag decompress its chunks within the limit."""
    reader.chunks = {
        at: chunk._replace(decompressor=_LIMITED.get(chunk.decompressor, chunk.decompressor))
        for at, chunk in reader.chunks.items()
    }


def take_unpacking(reader: Any) -> bool:
    """Whether the messages of an open reader of a rosbag2 are compressed one by one: it then gives them as they are."""
    about = reader.storage.metadata
    packed = about.compression_mode == "message"
    if packed:
        reader.storage.metadata = about._replace(compression_mode=None)
    return packed
