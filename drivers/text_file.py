"""Text files of datasets."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from stereo_sfm import input_file
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import I64

LAST_NS = (1 << 63) - 1  # of stamps: in the year 2262


def stamp_ns(text: str) -> int:
    """A stamp in nanoseconds, as a whole number.

    Raises:
        ValueError: it is none, or none that a clock can have.
    """
    stamp = int(text)
    if not 0 <= stamp <= LAST_NS:
        raise ValueError(f"{text} is no time in nanoseconds")
    return stamp


def nanoseconds(stamps: Iterable[int], where: str) -> I64:
    """Stamps as an array; `where` they are, for the message.

    Raises:
        StereoSfmError: one is later than a clock can tell.
    """
    listed = list(stamps)
    if max(listed, default=0) > LAST_NS:
        raise StereoSfmError(f"{where}: a stamp of {max(listed) / 1e9:g} s is later than the year 2262")
    return np.array(listed, np.int64)


def read_text(path: Path) -> str:
    """The text of a file in UTF-8, with or without a byte order mark.

    Raises:
        OSError: it cannot be read.
        StereoSfmError: it is in another encoding, no regular file, or larger than any text.
    """
    try:
        return input_file.read_text(path)
    except UnicodeDecodeError:
        raise StereoSfmError(f"{path} is not text in UTF-8: save it in that encoding") from None
