"""A version of a store as a map folder on a disk: of a robot, or of a program that makes the next version.

Only what changed since the version on the disk is fetched. The folder is replaced as a whole when every checksum is
right; until then, and without a network, it is the version it was.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Set
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.fleet.patches import expanded
from stereo_sfm.fleet.versions import HEAD, StoredFile, Version, read_file, read_version, released
from stereo_sfm.folder_lock import FolderLock
from stereo_sfm.input_file import read_bytes, read_json
from stereo_sfm.maps.replace_folder import recover, replaced_folder
from stereo_sfm.maps.store import lock
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import cache_root, fetch, sha256
from stereo_sfm.storage.remote import Remote

log = logging.getLogger("stereo_sfm")

STATE = ".fleet.json"
START_S = 10.0  # that a robot with a map waits for each answer before it starts with that map
MOST_STEPS = 30  # versions that a robot may be behind and still take differences: a month of nights


@dataclass(frozen=True)
class Fetched:
    """What a fetch did."""

    version: int
    before: int  # 0: nothing
    received: int  # bytes of files; the version's own object and the head are 1 to 20 kB besides


def version_of(folder: Path, store: Remote | None = None) -> tuple[str, int]:
    """Name and number of the version in a folder; "" and 0 if it is none, or one of another store than `store`."""
    try:
        data = read_json(folder / STATE)
        mine = store is None or data["store"] == str(store)
        return (str(data["version"]), int(data["number"])) if mine else ("", 0)
    except (OSError, ValueError, KeyError, TypeError):
        return "", 0


def fetch_version(store: Remote, version: Version, folder: Path) -> Fetched:
    """Make a folder this version of a store. Files that are not of the store's versions stay.

    Raises:
        StereoSfmError: a file is damaged in the bucket, or cannot be fetched; the folder has a map that is of no store
            in a bucket; or another program writes it. The folder is as it was.
    """
    folder = folder.absolute()
    with lock(folder):
        return _fetch_version(store, version, folder)


def _fetch_version(store: Remote, version: Version, folder: Path) -> Fetched:
    recover(folder)
    name, before = version_of(folder, store)
    mine = {p.name: sha256(p) for p in folder.iterdir() if p.is_file()} if folder.is_dir() else {}
    own = sorted(version.files.keys() & mine.keys())
    if own and STATE not in mine:
        raise StereoSfmError(f"{folder} has {own[0]} of another map: choose another folder, or move that map away")
    if name == version.name and all(mine.get(n) == f.sha256 for n, f in version.files.items()):
        return Fetched(version.number, before, 0)
    known: Set[str] = frozenset()
    with suppress(objects.Missing):  # the store was deleted and begun anew
        known = read_version(store, name).files.keys() if name else known
    received = 0
    with replaced_folder(folder, frozenset({*version.files, *known, STATE})) as draft:
        for file_name in version.files:
            old = read_bytes(folder / file_name) if file_name in mine else None
            data, size = _file(store, version, file_name, old)
            received += size
            (draft / file_name).write_bytes(data)
        state = {"store": str(store), "version": version.name, "number": version.number}
        (draft / STATE).write_text(json.dumps(state, indent=1) + "\n", encoding="utf-8")
    for gone in known - version.files.keys():
        (folder / gone).unlink(missing_ok=True)
    return Fetched(version.number, before, received)


def _file(store: Remote, version: Version, name: str, old: bytes | None) -> tuple[bytes, int]:
    """The content of a file of a version, and the bytes that were fetched for it."""
    file = version.files[name]
    if old is not None:
        digest = hashlib.sha256(old).hexdigest()
        steps = _steps(store, version, name, digest, file.stored)
        data = _patched(store, old, steps) if steps is not None else None
        if data is not None:
            return data, sum(step.patched for step in steps or ())
    return read_file(store, file), file.stored


def _steps(store: Remote, version: Version, name: str, have: str, most: int) -> list[StoredFile] | None:
    """The differences from a file on the disk to that of a version, in order; None where there are none, or where the
    whole file has fewer bytes (`most`)."""
    out: list[StoredFile] = []
    for _ in range(MOST_STEPS):
        file = version.files.get(name)
        if file is None:
            return None
        if file.sha256 == have:
            return out[::-1]
        if not out or out[-1].sha256 != file.sha256:
            if not file.patched:
                return None
            out.append(file)
            if sum(step.patched for step in out) >= most:
                return None
        if file.base == have:
            return out[::-1]
        if not version.parent:
            return None
        version = read_version(store, version.parent)
    return None


def _patched(store: Remote, data: bytes, steps: list[StoredFile]) -> bytes | None:
    """A file after these differences; None where one of them is missing or damaged: the whole file is fetched then."""
    for step in steps:
        try:
            raw = objects.read(store / step.differences)
        except objects.Missing:
            return None
        made = expanded(raw, step.bytes, data)
        if made is None or hashlib.sha256(made).hexdigest() != step.sha256:
            return None
        data = made
    return data


def fetched_map(remote: Remote, robot: str = "") -> Path:
    """A map in a bucket as a folder of the cache: a robot's version of a store, or a map folder as it is.

    Where the network is away, or the version is damaged, it is the version that was fetched last.

    Raises:
        StereoSfmError: there is no map, or it is damaged.
    """
    place = _cached(remote)
    place.parent.mkdir(parents=True, exist_ok=True)
    with FolderLock(place.parent, "another program fetches this map: try again"):
        if not version_of(place)[1] and objects.exists(remote / "map.json"):
            return fetch(remote)
        fetch_released(remote, robot, place)
    return place


def _cached(store: Remote) -> Path:
    """Where a store's map is in the cache."""
    return cache_root() / "stores" / hashlib.sha256(str(store).encode()).hexdigest()[:16] / store.name


def fetched(remote: Remote) -> Path:
    """A copy of a file, a folder or a store's map in the cache."""
    a_store = version_of(_cached(remote))[1] or objects.exists(remote / HEAD)
    return fetched_map(remote) if a_store else fetch(remote)


def fetch_released(remote: Remote, robot: str, folder: Path) -> None:
    """Make a folder the version that a robot should have.

    Where the network is away, the version is damaged, or disk or memory are full, a folder that has one already stays
    as it is.

    Raises:
        StereoSfmError, OSError, MemoryError: it has none.
    """
    kept = version_of(folder, remote)[1]
    try:
        with objects.patience(START_S if kept else objects.PATIENCE_S):
            found = fetch_version(remote, released(remote, robot), folder)
        log.info("%s is version %d of %s, %.2f MB fetched", folder, found.version, remote, found.received / 1e6)
    except (StereoSfmError, OSError, MemoryError) as error:
        if not kept:
            raise
        log.warning("%s: %s stays version %d", str(error) or "too little memory", folder, kept)
