"""A store in a bucket, changed on this computer: fetched, changed, and written back as its next version."""

from __future__ import annotations

import hashlib
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import stereo_sfm
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.fleet.copies import STATE, fetch_version
from stereo_sfm.fleet.versions import Head, Version, publish, read_head, read_version
from stereo_sfm.fleet.work_folder import work_folder
from stereo_sfm.maps.columns import COLUMNS
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.storage.remote import Remote

ROLLED_BACK = "its version was rolled back"


def session_id(session: SavedMap) -> str:
    """A checksum of a session's own map: equal for equal maps, however they were saved or called."""
    digest = hashlib.sha256()
    for name in COLUMNS:
        column = session.sessions if name == "sessions" else getattr(session.snapshot, name)
        digest.update(f"{name}{column.dtype}{column.shape}".encode())
        digest.update(np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()[:32]


def holds(head: Head, version: Version | None, session: str) -> str:
    """Why a store with this head and its version does not take a session, "" if it does."""
    if version is not None and session in version.sessions:
        return "it is in the map already"
    return ROLLED_BACK if session in head.refused else ""


@dataclass
class Checkout:
    """The version that counts, in a folder of its own."""

    store: Remote
    head: Head
    version: Version | None  # None: the store has none yet
    folder: Path

    def holds(self, session: str) -> str:
        """Why a session is not put in, "" if it is to be."""
        return holds(self.head, self.version, session)

    def publish(self, sessions: Mapping[str, str], changes: list[str]) -> Version:
        """Make the folder the next version. Raises Changed if another program was faster."""
        return publish(self.store, self.folder, self.head, sessions, changes, f"stereo-sfm {stereo_sfm.__version__}")


@contextmanager
def checked_out(store: Remote, begin: bool = False) -> Generator[Checkout]:
    """Fetch the version that counts into a folder that lives as long as the block.

    Args:
        store: in a bucket. begin: one without a version is an empty folder.

    Raises:
        StereoSfmError: there is no version and `begin` is False.
    """
    with work_folder() as place:
        head = read_head(store)
        folder = place / store.name
        if not head.version:
            if not begin:
                raise StereoSfmError(f"no map at {store}: 'stereo-sfm map update {store} SESSION' begins one")
            yield Checkout(store, head, None, folder)
            return
        version = read_version(store, head.version)
        fetch_version(store, version, folder)
        (folder / STATE).unlink()
        yield Checkout(store, head, version, folder)
