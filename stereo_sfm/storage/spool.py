"""A file for a bucket that is written on this computer first, and stays here until it has arrived."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import Pace, cache_root, send_file, sha256
from stereo_sfm.storage.remote import Remote

SUM = ".sha256"  # beside an object: its checksum, as `sha256sum -c` reads it


@dataclass(frozen=True)
class Spool:
    """One file on its way."""

    file: Path  # here
    target: Remote

    @staticmethod
    def of(target: Remote, overwrite: bool) -> Spool:
        """Begin; nothing is written yet.

        Raises:
            StereoSfmError: there is such an object and `overwrite` is False, the bucket cannot be read, or an earlier
                file for this target has not been sent.
        """
        if objects.exists(target) and not overwrite:
            raise StereoSfmError(f"{target} exists: choose another name or use --overwrite")
        folder = cache_root() / "spool" / hashlib.sha256(str(target).encode()).hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / target.name
        if file.exists() and not overwrite:
            raise StereoSfmError(
                f"{file} was recorded for {target} and not sent: 'stereo-sfm fleet upload {file} {target}' sends it"
            )
        file.unlink(missing_ok=True)
        return Spool(file, target)

    def send(self, pace: Pace | None = None, keep: bool = False) -> None:
        """Send it, then its checksum, and remove it here, unless it is to be kept.

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
        if not keep:
            self.file.unlink()
