"""A folder of a job, on its own computer: walks with people in them stay nowhere when a worker is killed."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.folder_lock import FolderLock

_PREFIX = "stereo-sfm-job-"
_NEW_S = 60.0  # a folder that was just made may not be locked yet


@contextmanager
def work_folder() -> Generator[Path]:
    """An empty folder that is deleted at the end of the block; those that killed jobs left are deleted first."""
    sweep()
    with tempfile.TemporaryDirectory(prefix=_PREFIX) as name, FolderLock(Path(name), "this cannot be"):
        yield Path(name)


def sweep() -> None:
    """Delete the folders of jobs that live no more."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError, StereoSfmError):  # of another user, of a job that lives, or deleted by another sweep
            if time.time() - folder.stat().st_mtime > _NEW_S:
                with FolderLock(folder, "a job works in it"):
                    shutil.rmtree(folder)
