"""Files that a user names: regular ones only, and of a size that can be what they claim to be."""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path

from stereo_sfm.errors import StereoSfmError

MOST_TEXT = 1 << 30  # bytes of a text: a trajectory of a day at 30 Hz has some 200 MB
MOST_BYTES = 2 << 30  # of any file that is read as a whole


class NotAFile(StereoSfmError, OSError):
    """A pipe, a device, a folder, or a file too large for what it should be.

    An OSError, too: to who takes a file that cannot be read for a damaged one, it is one.
    """

    @classmethod
    def of(cls, path: Path, why: str) -> NotAFile:
        """For a message."""
        return cls(errno.EINVAL, why, str(path))

    def __str__(self) -> str:
        return f"cannot read {self.filename}: {self.strerror}"


def open_regular(path: Path, most: int | None = None) -> BufferedReader:
    """Open a file for reading. A pipe or a device is refused: it may never end, or hold the reader up.

    Args:
        path: the file. most: bytes.

    Raises:
        NotAFile: it is no regular file, or is larger.
        OSError: it cannot be opened.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    about = os.fstat(descriptor)
    if not stat.S_ISREG(about.st_mode):
        os.close(descriptor)
        raise NotAFile.of(path, "it is not a file")
    if most is not None and about.st_size > most:
        os.close(descriptor)
        raise NotAFile.of(path, f"it has {about.st_size / 1e6:.0f} MB, more than {most / 1e6:.0f}")
    return os.fdopen(descriptor, "rb")


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """The bytes of a file.

    Raises:
        NotAFile: it is no regular file, or is larger than this many bytes.
        OSError: it cannot be read.
    """
    with open_regular(path, most) as file:
        return file.read()


def read_text(path: Path, most: int = MOST_TEXT, encoding: str = "utf-8-sig") -> str:
    """The text of a file.

    Args:
        path: the file. most: bytes. encoding: of the text; by default UTF-8, with or without its mark.

    Raises:
        NotAFile: it is no regular file, or is larger.
        OSError: it cannot be read. UnicodeError: it is something else.
    """
    return read_bytes(path, most).decode(encoding)
