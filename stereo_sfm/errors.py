"""The one error root of the project."""

from __future__ import annotations

import errno
import importlib.util
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_OF_THE_DISK = (*_FULL, errno.EROFS, errno.EIO)


class StereoSfmError(Exception):
    """Something the user can mend: bad input, calibration, configuration or device.

    The message is one line that says what is wrong and what to do. The command line prints it and exits with
    ``exit_code``; every other exception is an internal error and keeps its traceback.
    """

    exit_code = 2


def require(modules: tuple[str, ...], extra: str, purpose: str, error: type[StereoSfmError] = StereoSfmError) -> None:
    """Ask for the libraries of one of the package's extras before they are imported.

    Raises:
        StereoSfmError (or the given kind): one of them is not installed.
    """
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        raise error(f"{purpose} needs {', '.join(missing)}: pip install 'stereo-sfm[{extra}]'")


def from_os_error(error: OSError) -> StereoSfmError | None:
    """What the system says of a file as one line; None for what is no fault of a file (a pipe between processes)."""
    kept = "what was written until then is kept"
    if error.filename is None:
        return StereoSfmError(f"cannot write: {error.strerror}; {kept}") if error.errno in _OF_THE_DISK else None
    if error.errno in _FULL:
        return StereoSfmError(f"cannot write to {error.filename}: {error.strerror}; {kept}")
    if isinstance(error, FileExistsError):
        return StereoSfmError(f"{error.filename}: a file of that name is there already")
    return StereoSfmError(f"{error.filename}: {error.strerror}")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """ ", did you mean NAME?" for a misspelt word of a list, whatever its case; "" where none is near."""
    from difflib import get_close_matches

    names = {name.lower(): name for name in known}
    near = get_close_matches(word.lower(), names, 1)
    return f", did you mean {names[near[0]]}?" if near else ""


def one_of(word: str, known: Iterable[str], what: str) -> str:
    """The word, which must be one of a list.

    Args:
        word: as the user wrote it.
        known: the list.
        what: what such a word stands for, for the message: "scene", "projection".

    Raises:
        StereoSfmError: it is none of them; with the nearest one and all of them.
    """
    names = tuple(known)
    if word in names:
        return word
    raise StereoSfmError(f"unknown {what} '{word}'{did_you_mean(word, names)} (choose one of {', '.join(names)})")


@contextmanager
def writing_to(folder: Path) -> Generator[None]:
    """Let a disk error name the folder: the system names files that it cannot open, not those that it cannot fill."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(folder)
        raise
