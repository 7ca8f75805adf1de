"""A file for a bucket that is written on this computer first, and stays here until it has arrived."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.folder_lock import FolderLock
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import Pace, cache_root, send_file, sha256, state_root, sum_of, sums_text
from stereo_sfm.storage.remote import Remote


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
        name = hashlib.sha256(str(target).encode()).hexdigest()[:16]
        file, left = [root / name / target.name for root in _roots()]
        file.parent.mkdir(parents=True, exist_ok=True)
        spool = Spool.kept(file, target)
        if left.is_file() and not file.exists():
            _take_over(Spool.kept(left, target), file)
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
        spooled = any(root in file.parents for root in _roots())
        remedy = f"choose another name than {target}, or wait until it is sent"
        return Spool(file, target, FolderLock(file.parent, remedy) if spooled else None)

    def send(self, pace: Pace | None = None) -> None:
        """Send it, then its checksum, and remove it from the spool.

        Raises:
            StereoSfmError: it cannot be sent; the file stays.
        """
        try:
            send_file(self.file, self.target, pace)
            objects.write(sum_of(self.target), sums_text({self.target.name: sha256(self.file)}))
        except StereoSfmError as error:
            raise StereoSfmError(
                f"{error}; it is kept: 'stereo-sfm fleet upload {self.file} {self.target}' sends it"
            ) from None
        if self.lock is not None:
            self.file.unlink()


def _roots() -> tuple[Path, Path]:
    """Of what waits, and of what earlier versions left in the cache, which may be deleted at any time."""
    return state_root().resolve() / "spool", cache_root().resolve() / "spool"


def _take_over(left: Spool, file: Path) -> None:
    """Move what an earlier version left: it is whole at its new place, or still at the old one."""
    part = file.with_name(f".{file.name}.moved")
    try:
        shutil.move(left.file, part)
    except OSError:  # such as a full disk
        part.unlink(missing_ok=True)
        raise
    part.replace(file)
