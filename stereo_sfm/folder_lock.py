"""A lock on a folder, against two processes that write to it."""

from __future__ import annotations

import fcntl
import os
import weakref
from pathlib import Path
from types import TracebackType
from typing import Self

from stereo_sfm.errors import StereoSfmError


class FolderLock:
    """Locks a folder as long as this object exists, or until the end of its `with` block.

    No file is written, a killed process leaves no lock.
    """

    def __init__(self, folder: Path, remedy: str) -> None:
        """Lock an existing folder; `remedy` ends the message of the error.

        Raises:
            StereoSfmError: another process holds the lock.
        """
        descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        self.release = weakref.finalize(self, os.close, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise StereoSfmError(f"another run is writing to {folder}: {remedy}") from None
        except OSError:  # a network file system without locks
            return

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()
