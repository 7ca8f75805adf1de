"""Whole files and folders between a bucket and this computer, checked by SHA-256.

A folder in a bucket that was written by `send_folder` has a file SHA256SUMS, as `sha256sum -c` reads it, written last:
a folder without it is not complete, or is of another program and is checked by its sizes alone.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import open_regular, read_bytes
from stereo_sfm.storage import objects
from stereo_sfm.storage.remote import Remote
from stereo_sfm.storage.stream import RangeStream

SUMS = "SHA256SUMS"
SUM = ".sha256"  # ends the name of an object beside a single file: its checksum, in the same form
PIECE = 1 << 20  # bytes read at a time


def cache_root() -> Path:
    """Where copies are kept: STEREO_SFM_CACHE, else the user's cache folder. It may be deleted at any time."""
    named = os.environ.get("STEREO_SFM_CACHE")
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "stereo-sfm"
    return Path(named) if named else base


def state_root() -> Path:
    """Where is kept what must not be lost: the user's folder for state (XDG_STATE_HOME).

    Raises:
        RuntimeError: this user has no home folder.
    """
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "stereo-sfm"


def sha256(path: Path) -> str:
    """Of a file."""
    with open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@dataclass
class Pace:
    """Holds a transfer to a number of bytes a second."""

    bytes_s: float = 0.0  # 0: no limit
    _due_s: float = field(default=0.0)

    def pieces(self, path: Path, stopped: Callable[[], bool] = lambda: False) -> Iterator[bytes]:
        """A file in pieces, each not before its time.

        Raises:
            InterruptedError: `stopped` became true.
        """
        with open_regular(path) as stream:
            while piece := stream.read(PIECE if not self.bytes_s else max(min(PIECE, int(self.bytes_s / 4)), 4096)):
                self.wait(len(piece), stopped)
                yield piece

    def wait(self, size: int, stopped: Callable[[], bool]) -> None:
        """Until so many bytes may be sent."""
        while self.bytes_s and (rest := self._due_s - time.monotonic()) > 0:
            if stopped():
                raise InterruptedError
            time.sleep(min(rest, 0.2))
        if self.bytes_s:
            self._due_s = max(self._due_s, time.monotonic()) + size / self.bytes_s


def fetch(remote: Remote) -> Path:
    """A copy of a file or a folder in the cache; what is there already and did not change is not fetched again.

    Raises:
        StereoSfmError: there is nothing of this name, or what came is not what was sent.
    """
    files = _files(remote)
    place = cache_root() / hashlib.sha256(str(remote).encode()).hexdigest()[:16]
    state = hashlib.sha256(repr(files).encode()).hexdigest()[:16]
    target = place / state / remote.name
    if target.exists():
        return target
    draft = place / f".{state}.{os.getpid()}"
    shutil.rmtree(draft, ignore_errors=True)
    try:
        _fetch_files(remote, files, draft / remote.name)
        for older in [p for p in place.iterdir() if not p.name.startswith(".")]:
            shutil.rmtree(older, ignore_errors=True)
        try:
            draft.rename(place / state)
        except OSError:
            if not target.exists():  # else another process fetched the same meanwhile
                raise
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return target


def fetch_into(remote: Remote, target: Path) -> None:
    """Write a file or a folder to a path that does not exist yet. Errors as of `fetch`."""
    _fetch_files(remote, _files(remote), target)


def _files(remote: Remote) -> list[tuple[str, int, str]]:
    """(name, bytes, tag) of each file; the name is "" where the address is that of a file."""
    try:
        return [("", *objects.size_and_tag(remote))]
    except objects.Missing:
        files = objects.listed(remote)
    if not files:
        raise objects.Missing(f"there is no {remote}")
    outside = [name for name, _, _ in files if not name or {"", ".", ".."} & set(name.split("/"))]
    if outside:
        raise StereoSfmError(f"{remote} has {outside[0]!r}, which is no file in a folder: it is not fetched")
    return files


def _fetch_files(remote: Remote, files: list[tuple[str, int, str]], target: Path) -> None:
    for name, size, _ in files:
        fetch_file(remote / name if name else remote, target / name if name else target, size)
    if target.is_dir():
        check_sums(target, str(remote))
    else:
        _check_sum(target, remote)


def fetch_file(remote: Remote, path: Path, size: int) -> None:
    """Write an object of this size into a file, in parts.

    Raises:
        StereoSfmError: it is shorter, or was replaced meanwhile.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as out, RangeStream(remote) as stream:
        while piece := stream.read(PIECE):
            out.write(piece)
    if path.stat().st_size != size:
        raise StereoSfmError(f"{remote} was replaced while it was read: try again")


def sums_text(sums: Mapping[str, str]) -> bytes:
    """The content of SHA256SUMS, from checksums by name."""
    return "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items())).encode()


def read_sums(text: str) -> dict[str, str]:
    """The checksums by name; lines that are none are left out."""
    pairs = (line.split("  ", 1) for line in text.splitlines())
    return {pair[1]: pair[0] for pair in pairs if len(pair) == 2}


def check_sums(folder: Path, name: str) -> None:
    """Compare a folder with its SHA256SUMS, if it has one.

    Raises:
        StereoSfmError: a file is missing or has other bytes. `name` says of what.
    """
    listing = folder / SUMS
    if not listing.is_file():
        return
    for file, digest in read_sums(read_bytes(listing).decode(errors="replace")).items():
        path = folder / file
        if not path.is_file() or sha256(path) != digest:
            raise StereoSfmError(f"{name}: {file} is not what was sent (its checksum is wrong): send it again")


def _check_sum(file: Path, remote: Remote) -> None:
    """Compare a file with the checksum beside its object, if there is one. Raises StereoSfmError as `check_sums`."""
    try:
        said = objects.read(sum_of(remote)).decode("utf-8", "replace")
    except objects.Missing:
        return
    digests = {digest.lower() for digest in re.findall(r"\b[0-9a-fA-F]{64}\b", said)}  # as any program writes them
    if digests and sha256(file) not in digests:
        raise StereoSfmError(f"{remote} is not what was sent (its checksum is wrong): send it again")


def sum_of(remote: Remote) -> Remote:
    """The object with the checksum of a single file."""
    return remote.parent / f"{remote.name}{SUM}"


def send_folder(folder: Path, remote: Remote, pace: Pace | None = None) -> int:
    """Write the files of a folder, then their checksums. What is there with the same bytes is not sent again: its
    checksum was sent, and its size is right.

    Returns:
        Bytes that were sent.
    """
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.name != SUMS)
    sums = {p.relative_to(folder).as_posix(): sha256(p) for p in files}
    known = sent_sums(remote)
    there = {name: size for name, size, _ in objects.listed(remote)} if known else {}
    sent = 0
    for name, digest in sums.items():
        size = (folder / name).stat().st_size
        if known.get(name) != digest or there.get(name) != size:
            send_file(folder / name, remote / name, pace)
            sent += size
    if known != sums:
        objects.write(remote / SUMS, sums_text(sums))
    return sent


def send_file(
    path: Path, remote: Remote, pace: Pace | None = None, stopped: Callable[[], bool] = lambda: False
) -> None:
    """Write one file; nobody sees it before it is whole.

    Raises:
        StereoSfmError: what arrived has another size, or it cannot be written. InterruptedError: `stopped` became true.
    """
    objects.write(remote, path if pace is None or not pace.bytes_s else pace.pieces(path, stopped))
    size = path.stat().st_size
    if objects.size_and_tag(remote)[0] != size:
        raise StereoSfmError(f"{remote} does not have the {size} bytes that were sent: try again")


def sent_sums(remote: Remote) -> dict[str, str]:
    """The checksums of a folder in a bucket; empty where there are none."""
    try:
        return read_sums(objects.read(remote / SUMS).decode("utf-8", "replace"))
    except objects.Missing:
        return {}
