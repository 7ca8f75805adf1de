"""Atomic replacement of a folder: written under a temporary name, then renamed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replaced_folder(folder: Path, names: frozenset[str]) -> Generator[Path]:
    """An empty folder to write into; it replaces `folder` at the end of the block.

    Until then `folder` is unchanged, also if the block raises or the process is killed (between the two renames at the
    end it is called .NAME.old). A folder with files other than `names`, or one that cannot be renamed (a mount, the
    working directory), is kept and gets the new files one by one.
    """
    folder = folder.resolve()
    folder.parent.mkdir(parents=True, exist_ok=True)
    keep = folder.exists() and (_cannot_move(folder) or any(path.name not in names for path in folder.iterdir()))
    draft = folder / ".partial" if keep else folder.with_name(f".{folder.name}.partial")
    _remove(draft)  # of a killed process
    draft.mkdir()
    try:
        yield draft
        for path in draft.iterdir():
            _sync(path)
        if keep:
            for path in sorted(draft.iterdir()):
                path.replace(folder / path.name)
        else:
            _swap(draft, folder)
        _sync(folder.parent)
    finally:
        _remove(draft)


def _sync(path: Path) -> None:
    """A file or folder survives a loss of power from now on."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:  # a file system that cannot
        return
    finally:
        os.close(descriptor)


def _cannot_move(folder: Path) -> bool:
    here = Path.cwd()
    return folder.is_mount() or folder == here or folder in here.parents


def _swap(draft: Path, folder: Path) -> None:
    if not folder.exists():
        draft.rename(folder)
        return
    shutil.copymode(folder, draft)
    old = folder.with_name(f".{folder.name}.old")
    _remove(old)
    folder.rename(old)
    try:
        draft.rename(folder)
    except OSError:
        old.rename(folder)
        raise
    _remove(old)


def _remove(folder: Path) -> None:
    if os.path.lexists(folder):
        shutil.rmtree(folder)
