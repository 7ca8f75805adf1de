"""Arrays of npz files that others may have written: what they state is checked before it is believed.

A megabyte of npz can stand for a gigabyte, and a header of a hundred bytes for an array of any size.
"""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.lib import format as npy

SMALL = 64 << 20  # bytes that any file may hold
MOST_RATIO = 20  # ... and beyond that so many times its own size; arrays of measurements hardly shrink
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def read_arrays(raw: bytes) -> dict[str, Any]:
    """Every array of an npz file by name, writeable.

    Raises:
        ValueError: no npz file, damaged, or larger than its own size allows.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > SMALL + MOST_RATIO * len(raw):
                raise ValueError("its arrays are far larger than the file")
            if any(entry.compress_type not in _METHODS or entry.flag_bits & 1 for entry in entries):
                raise ValueError("its arrays are packed in an unknown way")
            return {entry.filename.removesuffix(".npy"): _array(archive.read(entry)) for entry in entries}
    except (zipfile.BadZipFile, zipfile.LargeZipFile, EOFError, OSError, zlib.error, MemoryError) as error:
        raise ValueError(f"no npz file or a damaged one ({error})") from None


def _array(data: bytes) -> Any:
    stream = io.BytesIO(data)
    version = npy.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"npy version {version} is not known")
    header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, by_column, dtype = header(stream)
    content = data[stream.tell() :]
    if dtype.hasobject or dtype.itemsize == 0 or math.prod(shape) * dtype.itemsize != len(content):
        raise ValueError("an array does not hold what its header states")
    return np.frombuffer(content, dtype).reshape(shape, order="F" if by_column else "C").copy()
