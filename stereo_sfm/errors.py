"""The exception for everything that the user can fix, and helpers for its messages."""

from __future__ import annotations

import errno
import importlib.util
import re
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_DISK_ERRORS = (*_FULL, errno.EROFS, errno.EIO)


class StereoSfmError(Exception):
    """Something the user can fix: bad input, calibration, configuration or device.

    The message is one line that says what is wrong and what to do. The command line prints it and exits with
    ``exit_code``; every other exception is an internal error and keeps its traceback.
    """

    exit_code = 2  # of a command that ends with it
    stage = ""  # of a pipeline in processes, which failed with it


class Hindered(StereoSfmError):
    """Nothing is wrong with the input: no room, no right or no network, here and now. It may do another time."""


def require(modules: tuple[str, ...], extra: str, purpose: str, error: type[StereoSfmError] = StereoSfmError) -> None:
    """Check that the libraries of one of the package's extras are installed.

    Raises:
        StereoSfmError (or the given kind): one of them is not installed.
    """
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        raise error(f"{purpose} needs {', '.join(missing)}: pip install 'stereo-sfm[{extra}]'")


def from_os_error(error: OSError) -> Hindered | None:
    """A one-line error for a problem with a file; None for others (a pipe between processes)."""
    kept = "what was written so far is kept"
    if error.filename is None:
        return Hindered(f"cannot write: {error.strerror}; {kept}") if error.errno in _DISK_ERRORS else None
    if error.errno in _FULL:
        return Hindered(f"cannot write to {error.filename}: {error.strerror}; {kept}")
    if isinstance(error, FileExistsError):
        return Hindered(f"{error.filename}: a file with this name exists already")
    return Hindered(f"{error.filename}: {error.strerror}")


def printable(text: str) -> str:
    """A text that UTF-8 can hold: of a file name in another encoding, each odd byte is a replacement character."""
    return re.sub("[\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", text)


def disk_is_full(error: BaseException) -> bool:
    """Whether it says, or was raised because, nothing more fits on a disk."""
    return any(isinstance(e, OSError) and e.errno in _FULL for e in (error, error.__context__))


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """ ", did you mean NAME?" with the nearest known word, ignoring case; "" if none is near."""
    from difflib import get_close_matches

    names = {name.lower(): name for name in known}
    near = get_close_matches(word.lower(), names, 1)
    return f", did you mean {names[near[0]]}?" if near else ""


def one_of(word: str, known: Iterable[str], what: str) -> str:
    """Return a word after checking that it is known.

    Args:
        word: as the user wrote it.
        known: the list.
        what: what the word names, for the message: "scene", "projection".

    Raises:
        StereoSfmError: unknown; the message lists the nearest word and all of them.
    """
    names = tuple(known)
    if word in names:
        return word
    raise StereoSfmError(f"unknown {what} '{word}'{did_you_mean(word, names)} (choose one of {', '.join(names)})")


@contextmanager
def writing_to(folder: Path) -> Generator[None]:
    """Add the folder to disk errors: the system names files that cannot be opened, but not when the disk is full."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(folder)
        raise
