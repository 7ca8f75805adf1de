"""A file for a bucket that is written on this computer first, and stays here until it has arrived."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.folder_lock import FolderLock
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import Pace, cache_root, send_file, sha256
from stereo_sfm.storage.remote import Remote

SUM = ".sha256"  # beside an object: its checksum, as `sha256sum -c` reads it


@dataclass(frozen=True)
class Spool:
    """One file on its way; while this object exists, no other run writes, sends or replaces it."""

    file: Path  # here
    target: Remote
    lock: FolderLock | None  # None: of another folder than the spool, where the file is to stay

    @staticmethod
    def of(target: Remote, overwrite: bool) -> Spool:
        """Begin; nothing is written yet, and an earlier file stays until the new one replaces it.

        Raises:
            StereoSfmError: there is such an object and `overwrite` is False, the bucket cannot be read, an earlier
                file for this target has not been sent, or another run has begun one.
        """
        folder = _root() / hashlib.sha256(str(target).encode()).hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
        spool = Spool.kept(folder / target.name, target)
        if objects.exists(target) and not overwrite:
            raise StereoSfmError(f"{target} exists: choose another name or use --overwrite")
        if spool.file.exists() and not overwrite:
            raise StereoSfmError(
                f"{spool.file} was recorded for {target} and not sent:"
                f" 'stereo-sfm fleet upload {spool.file} {target}' sends it"
            )
        return spool

    @staticmethod
    def kept(file: Path, target: Remote) -> Spool:
        """A file that is here.

        Raises:
            StereoSfmError: another run records or sends it.
        """
        file = file.resolve()
        spooled = _root() in file.parents
        remedy = f"choose another name than {target}, or wait until it is sent"
        return Spool(file, target, FolderLock(file.parent, remedy) if spooled else None)

    def send(self, pace: Pace | None = None) -> None:
        """Send it, then its checksum, and remove it from the spool.

        Raises:
            StereoSfmError: it cannot be sent; the file stays.
        """
        try:
            send_file(self.file, self.target, pace)
            objects.write(
                self.target.parent / f"{self.target.name}{SUM}", f"{sha256(self.file)}  {self.file.name}\n".encode()
            )
        except StereoSfmError as error:
            raise StereoSfmError(
                f"{error}; it is kept: 'stereo-sfm fleet upload {self.file} {self.target}' sends it"
            ) from None
        if self.lock is not None:
            self.file.unlink()


def _root() -> Path:
    return cache_root().resolve() / "spool"
