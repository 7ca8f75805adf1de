"""The map of a store over months: one map folder, its earlier versions beside it, and what people wrote about it.

STORE is a map folder like any other, with `store.yaml` (floor frame, labels), `changes.txt` (what the last session
changed) and whatever else people put there, which updates keep. STORE.versions holds earlier versions by number and is
locked while STORE is written.
"""

from __future__ import annotations

import dataclasses
import shutil
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.folder_lock import FolderLock
from stereo_sfm.input_file import read_bytes, read_yaml
from stereo_sfm.maps.floor import floor_of
from stereo_sfm.maps.labels import Aisle, Door
from stereo_sfm.maps.replace_folder import content
from stereo_sfm.maps.saved_map import SavedMap, load_map, map_files, save_map
from stereo_sfm.maps.unfinished import copy_map
from stereo_sfm.types import F64

ABOUT, CHANGES = "store.yaml", "changes.txt"
MOST_ABOUT = 1 << 20  # bytes: ten thousand labels
KEPT_VERSIONS = 5  # earlier ones: a working week


@dataclass(frozen=True, eq=False)
class About:
    """What is known of a store besides its map."""

    version: int  # counts updates
    map_T_floor: F64  # (4, 4) set once, so that labels and plans stay valid
    aisles: tuple[Aisle, ...] = ()
    doors: tuple[Door, ...] = ()


def versions_folder(store: Path) -> Path:
    """Where earlier versions are: beside the folder itself, also for a link to it or `..`."""
    return store.resolve().parent / f"{store.resolve().name}.versions"


def lock(store: Path) -> FolderLock:
    """Lock a store for writing.

    Raises:
        StereoSfmError: another process writes to it.
    """
    folder = versions_folder(store)
    folder.mkdir(parents=True, exist_ok=True)
    return FolderLock(folder, f"wait until the map {store} is written, or stop the service that extends it")


def lock_about(store: Path) -> FolderLock:
    """Lock what people wrote about a store, which a running service leaves as it is.

    Raises:
        StereoSfmError: another process writes it.
    """
    folder = versions_folder(store) / "about"
    folder.mkdir(parents=True, exist_ok=True)
    return FolderLock(folder, f"labels or plans of {store} are being written: try again")


def load_current(store: Path) -> SavedMap:
    """The map of a store; one that a running service replaces meanwhile is read again.

    Raises:
        StereoSfmError: as `load_map`.
    """
    while True:
        before = content(store)
        try:
            return load_map(store)
        except StereoSfmError:
            if content(store) == before:
                raise


def lock_versioned(folder: Path) -> AbstractContextManager[object]:
    """Lock a map folder if it is a store; any other is not locked.

    Raises:
        StereoSfmError: another process writes to it.
    """
    return lock(folder) if versions_folder(folder).is_dir() else nullcontext()


def read_about(store: Path, saved: SavedMap | None = None) -> About:
    """What `store.yaml` says; without it, the floor of the map.

    Raises:
        StereoSfmError: the file is damaged.
    """
    path = store / ABOUT
    if not path.is_file():
        return About(0, floor_of(load_current(store) if saved is None else saved))
    try:
        data: Any = read_yaml(path, MOST_ABOUT)
        aisles = tuple(Aisle(*_line(line)) for line in data["aisles"])
        doors = tuple(Door(*_line(line)) for line in data.get("doors", ()))
        pose = np.array(data["map_T_floor"], float).reshape(4, 4)
        return About(int(data["version"]), pose, aisles, doors)
    except (AttributeError, KeyError, TypeError, ValueError, OSError):
        raise StereoSfmError(f"{path} is damaged: correct it, or remove it to begin without labels") from None


def _line(data: Any) -> tuple[str, tuple[float, float], tuple[float, float]]:
    (x0, y0), (x1, y1) = data["start"], data["end"]
    return str(data["name"]), (float(x0), float(y0)), (float(x1), float(y1))


def _about_text(about: About) -> bytes:
    aisles, doors = (
        [{"name": line.name, "start": list(line.start), "end": list(line.end)} for line in lines]
        for lines in (about.aisles, about.doors)
    )
    data = {"version": about.version, "map_T_floor": about.map_T_floor.tolist(), "aisles": aisles, "doors": doors}
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True).encode()


def write_about(store: Path, about: About) -> None:
    """Replace `store.yaml`."""
    draft = store / f".{ABOUT}"
    draft.write_bytes(_about_text(about))
    draft.replace(store / ABOUT)


def write_version(
    store: Path, saved: SavedMap, changes: list[str], keep: int = KEPT_VERSIONS, compress: bool = True
) -> int:
    """Make this map the newest version of a store, which the caller has locked; the version before is kept.

    `compress` as of `save_map`.

    Returns:
        The number of the version.
    """
    with lock_about(store):
        if (store / "map.json").exists():
            about = read_about(store)
            copy_map(store, versions_folder(store) / f"{about.version:05d}")
            about = dataclasses.replace(about, version=about.version + 1)
        else:
            about = About(0, floor_of(saved))
        lines = "".join(f"{line}\n" for line in changes)
        save_map(saved, store, _extras(store) | {ABOUT: _about_text(about), CHANGES: lines.encode()}, compress)
        # Those of a store that was here before this one, which count no more, have higher numbers and go first.
        for number in sorted(versions(store), key=lambda n: (n < about.version, n))[: -keep or None]:
            shutil.rmtree(versions_folder(store) / f"{number:05d}")
        return about.version


def _extras(store: Path) -> dict[str, bytes]:
    """The files of a store that are not the map's."""
    if not store.is_dir():
        return {}
    paths = [p for p in sorted(store.iterdir()) if p.is_file() and p.name not in map_files()]
    return {p.name: read_bytes(p) for p in paths}


def versions(store: Path) -> list[int]:
    """Numbers of the kept earlier versions, ascending."""
    folder = versions_folder(store)
    return sorted(int(p.parent.name) for p in folder.glob("*/map.json") if p.parent.name.isdigit())


def undo(store: Path) -> int:
    """Bring back the version before, in a locked store; labels and what people put beside the map stay.

    Returns:
        Its number.

    Raises:
        StereoSfmError: there is none.
    """
    kept = [number for number in versions(store) if number < read_about(store).version]
    if not kept:
        raise StereoSfmError(f"no earlier version of {store} is kept")
    folder = versions_folder(store) / f"{kept[-1]:05d}"
    about = dataclasses.replace(read_about(store), version=kept[-1])
    changes = read_bytes(folder / CHANGES) if (folder / CHANGES).is_file() else b""
    save_map(load_map(folder), store, _extras(store) | {ABOUT: _about_text(about), CHANGES: changes})
    shutil.rmtree(folder)
    return kept[-1]
