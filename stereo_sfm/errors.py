"""The one error root of the project."""

from __future__ import annotations

import errno

_OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EFBIG)


class StereoSfmError(Exception):
    """Something the user can mend: bad input, calibration, configuration or device.

    The message is one line that says what is wrong and what to do. The command line prints it and exits with
    ``exit_code``; every other exception is an internal error and keeps its traceback.
    """

    exit_code = 2


def from_os_error(error: OSError) -> StereoSfmError | None:
    """What the system says of a file as one line; None for what is no fault of a file (a pipe between processes)."""
    if error.filename is None:
        kept = "what was written until then is kept"
        return StereoSfmError(f"cannot write: {error.strerror}; {kept}") if error.errno in _OF_THE_DISK else None
    if isinstance(error, FileExistsError):
        return StereoSfmError(f"{error.filename}: a file of that name is there already")
    return StereoSfmError(f"{error.filename}: {error.strerror}")
