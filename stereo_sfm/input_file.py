"""Files that a user names: regular ones only, and of a size that can be what they claim to be."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from stereo_sfm.errors import StereoSfmError

MOST_TEXT = 1 << 30  # bytes of a text: a trajectory of a day at 30 Hz has some 200 MB
MOST_BYTES = 2 << 30  # of any file that is read as a whole


def open_regular(path: Path, most: int | None = None) -> BinaryIO:
    """Open a file for reading. A pipe or a device is refused: it may never end, or hold the reader up.

    Args:
        path: the file. most: bytes.

    Raises:
        StereoSfmError: it is no regular file, or is larger.
        OSError: it cannot be opened.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    about = os.fstat(descriptor)
    if not stat.S_ISREG(about.st_mode):
        os.close(descriptor)
        raise StereoSfmError(f"cannot read {path}: it is not a file")
    if most is not None and about.st_size > most:
        os.close(descriptor)
        raise StereoSfmError(f"cannot read {path}: it has {about.st_size / 1e6:.0f} MB, more than {most / 1e6:.0f}")
    return os.fdopen(descriptor, "rb")


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """The bytes of a file.

    Raises:
        StereoSfmError: it is no regular file, or is larger than this many bytes.
        OSError: it cannot be read.
    """
    with open_regular(path, most) as file:
        return file.read()


def read_text(path: Path, most: int = MOST_TEXT, encoding: str = "utf-8-sig") -> str:
    """The text of a file.

    Args:
        path: the file. most: bytes. encoding: of the text; by default UTF-8, with or without its mark.

    Raises:
        StereoSfmError: it is no regular file, or is larger.
        OSError: it cannot be read. UnicodeError: it is something else.
    """
    return read_bytes(path, most).decode(encoding)
