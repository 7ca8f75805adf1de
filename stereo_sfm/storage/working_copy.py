"""A file or folder in a bucket that a command reads or writes as a path: a copy here, whose changes are sent."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import SUMS, fetch, send_file, send_folder, sha256
from stereo_sfm.storage.remote import Remote

HEAD = "head.json"  # of a store with versions


@dataclass(frozen=True)
class WorkingCopy:
    """What is in the bucket was fetched to `path`; what a command leaves beside it is sent as well."""

    remote: Remote
    path: Path
    before: dict[str, str]  # SHA-256 by path below `path`'s folder

    @staticmethod
    def of(remote: Remote) -> WorkingCopy:
        """Fetch it; nothing where there is nothing yet.

        Raises:
            StereoSfmError: it cannot be fetched, or is a store with versions, which nothing replaces.
        """
        if objects.exists(remote / HEAD):
            raise StereoSfmError(f"{remote} is a store with versions: 'stereo-sfm map update {remote} RUN' changes it")
        path = Path(tempfile.mkdtemp(prefix="stereo-sfm-")) / remote.name
        if objects.exists(remote):
            shutil.copy(fetch(remote), path)
        elif objects.listed(remote):
            shutil.copytree(fetch(remote), path)
        return WorkingCopy(remote, path, _sums(path.parent))

    def send(self) -> bool:
        """Send what has changed, and remove the copy.

        Returns:
            Whether anything had.

        Raises:
            StereoSfmError: it cannot be sent; the copy stays.
        """
        now, target = _sums(self.path.parent), self.remote.parent
        if now != self.before:
            try:
                for entry in sorted(self.path.parent.iterdir()):
                    if entry.is_dir():
                        send_folder(entry, target / entry.name)
                    elif self.before.get(entry.name) != now[entry.name]:
                        send_file(entry, target / entry.name)
                objects.delete(target / name for name in self.before.keys() - now.keys())
            except StereoSfmError as error:
                raise StereoSfmError(f"{error}: what was written is kept in {self.path}") from None
        shutil.rmtree(self.path.parent, ignore_errors=True)
        return now != self.before


def _sums(folder: Path) -> dict[str, str]:
    files = (p for p in folder.rglob("*") if p.is_file() and p.name != SUMS)
    return {p.relative_to(folder).as_posix(): sha256(p) for p in files}
