"""Atomic replacement of a folder: written under a temporary name, then renamed."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

COMPLETE = ".complete"  # in a folder that is kept: the new files, all written


@contextmanager
def replaced_folder(folder: Path, names: frozenset[str], synced: bool = True) -> Generator[Path]:
    """An empty folder to write into; it replaces `folder` at the end of the block.

    Until then `folder` is unchanged, also if the block raises or the process is killed; what a process killed at the
    end leaves, `recover` puts right. A folder with files other than `names`, or one that cannot be renamed (a mount,
    the working directory), is kept and gets the new files one by one. Without `synced` a loss of power may damage it.
    """
    folder = folder.resolve()
    folder.parent.mkdir(parents=True, exist_ok=True)
    recover(folder)
    keep = folder.exists() and (_cannot_move(folder) or any(path.name not in names for path in folder.iterdir()))
    draft = folder / ".partial" if keep else _beside(folder, "partial")
    draft.mkdir()
    try:
        yield draft
        for path in draft.iterdir() if synced else ():
            sync(path)
        if keep:
            draft.rename(folder / COMPLETE)
            sync(folder)
            _take_complete(folder)
        else:
            _swap(draft, folder, names)
        if synced:
            sync(folder.parent)
    finally:
        _remove(draft)


def recover(folder: Path) -> None:
    """After a process was killed while it replaced a folder: the folder is the new one if that was complete, else the
    old one, and nothing else is left. Only for the program that replaces it, while nobody else does."""
    folder = folder.resolve()
    draft, old = _beside(folder, "partial"), _beside(folder, "old")
    if old.exists() and not folder.exists():  # killed between two renames: the new one was complete
        (draft if draft.exists() else old).rename(folder)
    if (folder / COMPLETE).is_dir():
        _take_complete(folder)
    for left in (draft, old, folder / ".partial"):
        _remove(left)


def content(folder: Path) -> dict[str, tuple[int, int]]:
    """Tells each file of a folder from others of its name; COMPLETE is one of them while they are replaced."""
    with contextlib.suppress(OSError):  # none; between two renames, too
        found = [entry for entry in os.scandir(folder) if entry.is_file() or entry.name == COMPLETE]
        return {entry.name: (entry.stat().st_ino, entry.stat().st_mtime_ns) for entry in found}
    return {}


def _beside(folder: Path, ending: str) -> Path:
    return folder.with_name(f".{folder.name}.{ending}")


def _take_complete(folder: Path) -> None:
    complete = folder / COMPLETE
    for path in sorted(complete.iterdir()):
        path.replace(folder / path.name)
    complete.rmdir()


def sync(path: Path) -> None:
    """A file or folder survives a loss of power from now on."""
    descriptor = os.open(path, os.O_RDONLY)
    with contextlib.suppress(OSError):  # a file system that cannot
        os.fsync(descriptor)
    os.close(descriptor)


def _cannot_move(folder: Path) -> bool:
    here = Path.cwd()
    return folder.is_mount() or folder == here or folder in here.parents


def _swap(draft: Path, folder: Path, names: frozenset[str]) -> None:
    """Other files than `names`, which somebody has written into the old folder meanwhile, move into the new one."""
    if not folder.exists():
        draft.rename(folder)
        return
    shutil.copymode(folder, draft)
    old = _beside(folder, "old")
    folder.rename(old)
    try:
        draft.rename(folder)
    except OSError:
        old.rename(folder)
        raise
    for path in [path for path in old.iterdir() if path.name not in names]:
        path.rename(folder / path.name)
    _remove(old)


def _remove(folder: Path) -> None:
    if os.path.lexists(folder):
        shutil.rmtree(folder)
