"""Chunks have the bytes that the library writes."""

from __future__ import annotations

import io

import numpy as np
from mcap.writer import CompressionType, Writer

from stereo_sfm.log.chunk_builder import Chunk


def _written(own: bool) -> bytes:
    file, rng = io.BytesIO(), np.random.default_rng(0)
    writer = Writer(file, chunk_size=2000, compression=CompressionType.NONE)
    if own:
        setattr(writer, "_Writer__chunk_builder", Chunk())  # noqa: B010
    writer.start(library="test")
    channels = [writer.register_channel(f"/{k}", "raw", 0) for k in range(3)]
    for k in range(200):
        data = rng.bytes(int(rng.integers(0, 100)))
        writer.add_message(channels[k % 3], int(rng.integers(2**60)), data, 10**18 + k, k)
    writer.finish()
    return file.getvalue()


def test_the_bytes_are_those_of_the_library() -> None:
    assert _written(True) == _written(False)
