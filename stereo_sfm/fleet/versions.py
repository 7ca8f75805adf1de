"""The versions of a store's map in a bucket.

    STORE/head.json                   the version that counts: exchanged on the condition that nobody else did
    STORE/release.json                the version of each robot; without it, or if that was rolled back, the head's
    STORE/versions/00012-5f0c...json  a version: its files, its sessions, its parent; never changed
    STORE/files/00012-5f0c.../SHA256.zst    a file as a whole, of the version that wrote it
    STORE/patches/00012-5f0c.../SHA256.zst  the same file as its differences from the parent's

Two programs that write at the same time both write objects of their own; the exchange of the head decides, and the
other program learns of it. A version that lost is never read by anybody. A new version names objects of its own and
of its parent only, so those that no kept version names can be deleted beside a program that writes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import re
import secrets
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Any, TypeVar

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.fleet.patches import compressed, expanded, patch
from stereo_sfm.input_file import read_bytes
from stereo_sfm.storage import objects
from stereo_sfm.storage.remote import Remote

HEAD, RELEASE = "head.json", "release.json"
KIND = "stereo_sfm_store"
_MANIFEST = re.compile(r"versions/(\d{5,})-[0-9a-f]+\.json")
_CONTENT = re.compile(r"(?:files|patches)/(?:(\d{5,})-[0-9a-f]+/)?[0-9a-f-]+\.zst")
T = TypeVar("T")


@dataclass(frozen=True)
class StoredFile:
    """A file of a version."""

    sha256: str
    bytes: int
    stored: int  # bytes of the object that holds it as a whole
    patched: int = 0  # bytes of its differences from the parent's file; 0: there are none
    base: str = ""  # SHA-256 of the parent's file
    at: str = ""  # folder of the version that wrote it, "" of stores of before, which had one folder for all

    @property
    def whole(self) -> str:
        """Name of the object that holds it as a whole."""
        return f"files/{self.at}/{self.sha256}.zst" if self.at else f"files/{self.sha256}.zst"

    @property
    def differences(self) -> str:
        """Name of the object that holds its differences from the parent's."""
        return f"patches/{self.at}/{self.sha256}.zst" if self.at else f"patches/{self.base}-{self.sha256}.zst"


@dataclass(frozen=True)
class Version:
    """A version of a store. Two of them with equal files have equal bits."""

    number: int
    parent: str  # name of its object, "" of the first
    files: Mapping[str, StoredFile]
    sessions: Mapping[str, str]  # checksum of a session's own map -> its name, for all that are in the map
    changes: tuple[str, ...]
    software: str
    by: str  # random: tells two writers apart
    name: str = field(default="", compare=False)  # of its object

    def text(self) -> bytes:
        data = {"kind": KIND, **dataclasses.asdict(self)}
        del data["name"]
        return (json.dumps(data, indent=1, sort_keys=True) + "\n").encode()


@dataclass(frozen=True)
class Head:
    """Which version counts."""

    version: str = ""  # name of its object, "": none yet
    next: int = 1  # number of the version that is made next: numbers are never used again
    refused: tuple[str, ...] = ()  # sessions of versions that were rolled back: they are not put in again
    by: str = ""
    oldest: int = 0  # number of the first version whose files are kept, besides those that robots were given
    undone: tuple[str, ...] = ()  # names of versions that were rolled back: no robot is given them
    tag: str | None = None  # of the object; None: there is none

    def text(self) -> bytes:
        data = {"kind": KIND, **dataclasses.asdict(self)}
        del data["tag"]
        return (json.dumps(data, indent=1, sort_keys=True) + "\n").encode()


def _parsed(remote: Remote, raw: bytes, make: Callable[[dict[str, Any]], T]) -> T:
    try:
        data = json.loads(raw)
        if data.pop("kind") != KIND:
            raise ValueError
        return make(data)
    except (ValueError, KeyError, TypeError, AttributeError):
        raise StereoSfmError(f"{remote} is damaged, or is no store of stereo-sfm") from None


def read_head(store: Remote) -> Head:
    """Of a store; an empty one where there is none."""
    try:
        raw, tag = objects.read_tagged(store / HEAD)
    except objects.Missing:
        return Head()

    def make(data: dict[str, Any]) -> Head:
        refused, undone = tuple(data["refused"]), tuple(data.get("undone", ()))
        return Head(data["version"], data["next"], refused, data["by"], data.get("oldest", 0), undone, tag)

    return _parsed(store / HEAD, raw, make)


def read_version(store: Remote, name: str) -> Version:
    """A version by the name of its object.

    Raises:
        StereoSfmError: there is none, or it is damaged.
    """

    def make(data: dict[str, Any]) -> Version:
        files = {key: StoredFile(**file) for key, file in data["files"].items()}
        if any(Path(key).name != key or key in ("", "..") for key in files):
            raise ValueError("a file of a map has a plain name")
        fields: dict[str, Any] = {**data, "files": files, "changes": tuple(data["changes"]), "name": name}
        return Version(**fields)

    return _parsed(store / name, objects.read(store / name), make)


def current(store: Remote) -> Version:
    """The version that counts.

    Raises:
        StereoSfmError: there is none yet.
    """
    return _counting(store, read_head(store))


def _counting(store: Remote, head: Head) -> Version:
    if not head.version:
        raise StereoSfmError(f"no map at {store}: 'stereo-sfm map update {store} SESSION' begins one")
    return read_version(store, head.version)


def history(store: Remote) -> list[Version]:
    """The version that counts and those before it, newest first."""
    now = current(store)
    return [now, *_chain(store, now.parent)]


def _chain(store: Remote, name: str) -> Iterator[Version]:
    """A version by its name, and those before it."""
    while name:
        version = read_version(store, name)
        yield version
        name = version.parent


def _counts(store: Remote, version: Version) -> bool:
    """Whether it is the version that counts, or one before it."""
    newer = takewhile(lambda v: v.number >= version.number, _chain(store, read_head(store).version))
    return version.name in [v.name for v in newer]


def numbered(store: Remote, number: int) -> Version:
    """A version that was the head at some time.

    Raises:
        StereoSfmError: there is none of this number.
    """
    for version in history(store):
        if version.number == number:
            return version
    # Rolled back: the head's history has it no more. Of two writers' versions the one that lost was removed.
    names = [name for name, _, _ in objects.listed(store) if (m := _MANIFEST.fullmatch(name)) and int(m[1]) == number]
    if len(names) == 1:
        return read_version(store, names[0])
    raise StereoSfmError(f"{store} has no version {number}: 'stereo-sfm map versions {store}' lists them")


def publish(
    store: Remote, folder: Path, head: Head, sessions: Mapping[str, str], changes: list[str], software: str
) -> Version:
    """Make the files of a folder the version that counts.

    Args:
        store: in a bucket. folder: the files. head: as it was when they were begun.
        sessions: checksum -> name of those in this version that its parent does not have.
        changes: lines for people. software: that made it.

    Raises:
        Changed: another program has written a version since `head` was read; this one is not in the store. Where it
            was written after this one, whose answer was lost, nothing is raised.
    """
    before = read_version(store, head.version) if head.version else None
    by = secrets.token_hex(8)
    at = f"{head.next:05d}-{by}"
    files: dict[str, StoredFile] = {}
    for path in sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")):
        old = before.files.get(path.name) if before else None
        files[path.name] = _stored(store, at, read_bytes(path), old)
    version = Version(
        head.next, before.name if before else "", files, {**(before.sessions if before else {}), **sessions},
        tuple(changes), software, by, f"versions/{at}.json",
    )  # fmt: skip
    objects.create(store / version.name, version.text())
    try:
        _exchange(store, dataclasses.replace(head, version=version.name, next=head.next + 1, by=by))
    except objects.Changed:
        if not _counts(store, version):
            objects.delete([store / version.name])
            raise
    return version


def _exchange(store: Remote, head: Head) -> None:
    try:
        objects.exchange(store / HEAD, head.text(), head.tag)
    except objects.Changed:
        raise objects.Changed(f"another program has written a version of {store} meanwhile: run this again") from None


def _stored(store: Remote, at: str, data: bytes, old: StoredFile | None) -> StoredFile:
    """Write a file's objects into a version's folder, unless the parent has the same file."""
    digest = hashlib.sha256(data).hexdigest()
    if old is not None and old.sha256 == digest:
        return old
    whole = compressed(data)
    differences = patch(read_file(store, old), data) if old is not None else whole
    if old is None or len(differences) >= len(whole):
        made = StoredFile(digest, len(data), len(whole), at=at)
    else:
        made = StoredFile(digest, len(data), len(whole), len(differences), old.sha256, at)
        objects.write(store / made.differences, differences)
    objects.write(store / made.whole, whole)
    return made


def read_file(store: Remote, file: StoredFile) -> bytes:
    """The content of a file, from the object that holds it as a whole.

    Raises:
        StereoSfmError: it is not what was written.
    """
    remote = store / file.whole
    data = expanded(objects.read(remote), file.bytes)
    if data is None or hashlib.sha256(data).hexdigest() != file.sha256:
        raise StereoSfmError(f"{remote} is damaged (its checksum is wrong): roll back, or write the version again")
    return data


def roll_back(store: Remote) -> Version:
    """Let the version before count again. The sessions of the one that counted are not put in again by themselves.

    Robots that were given the one that counted have what counts, again. One exchange of the head does all of it.

    Raises:
        StereoSfmError: there is none before. Changed: another program has written meanwhile.
    """
    head = read_head(store)
    now = _counting(store, head)
    before = read_version(store, now.parent) if now.parent else None
    if before is None or before.number < head.oldest:
        raise StereoSfmError(f"no earlier version of {store} is kept")
    refused = sorted({*head.refused, *(now.sessions.keys() - before.sessions.keys())})
    undone, by = (*head.undone, now.name), secrets.token_hex(8)
    try:
        _exchange(store, dataclasses.replace(head, version=before.name, refused=tuple(refused), undone=undone, by=by))
    except objects.Changed:
        if _counts(store, now):  # else the answer was lost, and there is a version after it
            raise
    return before


def forget_versions(store: Remote, keep: int) -> int:
    """Delete the files of all but the last `keep` versions and those that robots were given.

    What a version is made of stays known (`history`). The head is exchanged first: who began before begins again.

    Returns:
        Bytes that were deleted.

    Raises:
        Changed: another program has written a version meanwhile; nothing was deleted.
    """
    head = read_head(store)
    last = history(store)[:keep] if head.version else []
    if len(last) < keep or last[-1].number <= head.oldest:
        return 0
    oldest = last[-1].number
    _exchange(store, dataclasses.replace(head, oldest=oldest, by=secrets.token_hex(8)))
    given, _ = _released(store, head)
    found = objects.listed(store)
    kept = {name for name, _, _ in found if (m := _MANIFEST.fullmatch(name)) and int(m[1]) >= oldest}
    named: set[str] = set()
    for name in sorted(kept.union(given.values())):
        with contextlib.suppress(objects.Missing):  # of a writer who was refused meanwhile
            for file in read_version(store, name).files.values():
                named |= {file.whole, file.differences}
    gone = {
        name: size
        for name, size, _ in found
        if name not in named and (m := _CONTENT.fullmatch(name)) and int(m[1] or 0) < oldest
    }
    objects.delete([store / name for name in gone])
    return sum(gone.values())


# -- staged roll-out ---------------------------------------------------------------------------------------------


def release(store: Remote, number: int, robots: tuple[str, ...] = ()) -> None:
    """Give a version to some robots, or to all of them.

    Raises:
        StereoSfmError: there is no such version, it was rolled back, or its files were deleted.
        Changed: another program has released one meanwhile.
    """
    name, head = numbered(store, number).name, read_head(store)
    if name in head.undone:
        raise StereoSfmError(f"version {number} of {store} was rolled back: no robot is given it; release another one")
    given, tag = _released(store, head)
    if number < head.oldest and name not in given.values():
        raise StereoSfmError(f"the files of version {number} of {store} were deleted: it is too old (keep_versions)")
    given = {**given, **dict.fromkeys(robots, name)} if robots else {"": name}
    data = {"kind": KIND, "by": secrets.token_hex(8), "robots": given}
    objects.exchange(store / RELEASE, (json.dumps(data, indent=1, sort_keys=True) + "\n").encode(), tag)


def _released(store: Remote, head: Head) -> tuple[dict[str, str], str | None]:
    """Version by robot ("": all others), without those that were rolled back, and the tag of the object."""
    try:
        raw, tag = objects.read_tagged(store / RELEASE)
    except objects.Missing:
        return {}, None
    given = _parsed(store / RELEASE, raw, lambda d: {str(k): str(v) for k, v in d["robots"].items()})
    return {robot: name for robot, name in given.items() if name not in head.undone}, tag


def released(store: Remote, robot: str = "") -> Version:
    """The version that a robot should have: its own, else that of all, else the one that counts."""
    head = read_head(store)
    given, _ = _released(store, head)
    name = given.get(robot, given.get(""))
    return read_version(store, name) if name else _counting(store, head)
