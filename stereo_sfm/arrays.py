"""npz files: written fast; read from unknown origin: declared sizes are checked before memory is allocated.

A megabyte of npz can expand to a gigabyte, and a header of a hundred bytes can declare an array of any size.
"""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

ALWAYS_ALLOWED_BYTES = 64 << 20  # uncompressed size allowed for any file
MAX_RATIO = 20  # compression ratio allowed beyond that; arrays of measurements hardly compress
LEVEL = 1  # of compression: measurements hardly compress, the highest one takes four times as long for 2 % less
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def write_arrays(path: Path, arrays: Mapping[str, Any], compress: bool = True) -> None:
    """Write an npz file; equal arrays give equal bytes."""
    method = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(path, "w", method, compresslevel=LEVEL) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:  # dated 1980
                npy.write_array(file, np.asanyarray(array), allow_pickle=False)


def read_arrays(raw: bytes, names: Collection[str] = ()) -> dict[str, Any]:
    """Arrays of an npz file by name, writeable. Args: names, of those to read, if not all.

    Raises:
        ValueError: not an npz file, damaged, or too large for its compressed size.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > ALWAYS_ALLOWED_BYTES + MAX_RATIO * len(raw):
                raise ValueError("its arrays are far larger than the file")
            if any(entry.compress_type not in _METHODS or entry.flag_bits & 1 for entry in entries):
                raise ValueError("its arrays use an unknown compression")
            named = [(entry.filename.removesuffix(".npy"), entry) for entry in entries]
            return {name: _array(archive.read(e)) for name, e in named if not names or name in names}
    except (zipfile.BadZipFile, zipfile.LargeZipFile, EOFError, OSError, zlib.error, MemoryError) as error:
        raise ValueError(f"not an npz file, or a damaged one ({error})") from None


def _array(data: bytes) -> Any:
    stream = io.BytesIO(data)
    version = npy.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"unknown npy version {version}")
    header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, by_column, dtype = header(stream)
    content = data[stream.tell() :]
    if dtype.hasobject or dtype.itemsize == 0 or math.prod(shape) * dtype.itemsize != len(content):
        raise ValueError("the size of an array does not match its header")
    return np.frombuffer(content, dtype).reshape(shape, order="F" if by_column else "C").copy()
