"""Files compressed as a whole, or as their differences from an earlier one (zstd with that one as its dictionary)."""

from __future__ import annotations

import zstandard

LEVEL = 12  # twice the time of the usual 3 for a few percent: a version is written once and read by many robots
MOST_BYTES = 1 << 31  # of a file: the limit of zstd's window


def compressed(data: bytes) -> bytes:
    """As a whole."""
    return zstandard.ZstdCompressor(level=LEVEL).compress(data)


def patch(old: bytes, new: bytes) -> bytes:
    """The differences of `new` from `old`."""
    window = max((len(old) + len(new)).bit_length(), 10)
    parameters = zstandard.ZstdCompressionParameters.from_level(LEVEL, window_log=min(window, 31), enable_ldm=True)
    return zstandard.ZstdCompressor(dict_data=_dictionary(old), compression_params=parameters).compress(new)


def expanded(data: bytes, size: int, old: bytes | None = None) -> bytes | None:
    """A file from its object; None where that is damaged.

    Args:
        data: of the object. size: of the file, the most that is taken. old: the earlier file, of a patch.

    Raises:
        MemoryError: there is too little of it, which says nothing about the object.
    """
    if size > MOST_BYTES:
        return None
    try:
        if zstandard.frame_content_size(data) != size:
            return None
        dictionary = None if old is None else _dictionary(old)
        reader = zstandard.ZstdDecompressor(dict_data=dictionary, max_window_size=1 << 31)
        return reader.decompress(data, max_output_size=size)
    except zstandard.ZstdError:
        return None


def _dictionary(old: bytes) -> zstandard.ZstdCompressionDict:
    return zstandard.ZstdCompressionDict(old, dict_type=zstandard.DICT_TYPE_RAWCONTENT)
