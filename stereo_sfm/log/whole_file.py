"""A file of one writer: locked while it is written, and beside an older one of its name until it is whole."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from pathlib import Path

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import open_regular, refuse_pipe

MODE = 0o644  # less what the umask takes


def being_written(path: Path) -> bool:
    """Whether a `WholeFile` of any process is open on it; False where there is no such file, or there are no locks."""
    try:
        with open_regular(path) as file:
            fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


class WholeFile:
    """Opens a file for writing; `finish` puts it in its place.

    Attributes:
        place: where the bytes are until then: the file itself, or a `.part` beside the one that it replaces.
        fd: its open descriptor.
    """

    def __init__(self, path: Path, overwrite: bool) -> None:
        """Args: path, its folder is made. overwrite: replace an existing file.

        Raises:
            StereoSfmError: the file exists, is a pipe, cannot be created, or another process is writing it.
        """
        if overwrite and path.is_symlink():  # it stays, and the file that it names is replaced
            path = Path(os.path.realpath(path))
        refuse_pipe(path)
        self.path = self.place = path
        self._older: int | None = None  # descriptor of the file that is replaced: its lock keeps out others
        try:
            if not path.parent.is_dir():
                path.parent.mkdir(parents=True)
            if overwrite and path.exists() and not path.is_file():  # a device
                self.fd = os.open(path, os.O_WRONLY | os.O_CLOEXEC)
                return
            if overwrite and path.exists():
                self._older = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
                self._lock(self._older)
                self.place = path.with_name(f"{path.stem}.part{path.suffix}")
            flags = os.O_CREAT | (os.O_EXCL if self.place == path else 0)
            self.fd = os.open(self.place, os.O_WRONLY | os.O_CLOEXEC | flags, MODE)
            self._lock(self.fd)
            os.truncate(self.fd, 0)
        except OSError as error:
            if error.errno == errno.EEXIST and path.exists():
                raise StereoSfmError(f"{path} exists: choose another name or use --overwrite") from None
            raise StereoSfmError(f"cannot write {path}: {error.strerror}") from None

    def _lock(self, descriptor: int) -> None:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise StereoSfmError(f"another process is writing {self.path}: choose another name, or wait") from None
        except OSError:  # a network file system without locks
            return

    @property
    def beside(self) -> bool:
        """Whether there is an older file, which `finish` replaces."""
        return self.place != self.path

    def finish(self) -> None:
        """Close it, and put it in its place. Once."""
        if self.beside:
            os.replace(self.place, self.path)
        self.close()

    def discard(self) -> None:
        """Close and remove it; an older file of its name stays."""
        if stat.S_ISREG(os.fstat(self.fd).st_mode):
            with contextlib.suppress(OSError):
                self.place.unlink()
        self.close()

    def close(self) -> None:
        """Close it where it is: what is not whole stays beside an older file of its name. Once."""
        for descriptor in (self.fd, self._older):
            if descriptor is not None:
                os.close(descriptor)
