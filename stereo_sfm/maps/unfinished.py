"""The map of a session that goes on: its own part alone, and where it lies in the saved map that it continues."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.arrays import read_arrays
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import read_bytes
from stereo_sfm.loop.vocabulary_file import configured_vocabulary
from stereo_sfm.maps.header import read_header
from stereo_sfm.maps.replace_folder import COMPLETE, content, replaced_folder
from stereo_sfm.maps.saved_map import SavedMap, load_map, map_files, save_map
from stereo_sfm.maps.update import update
from stereo_sfm.types import LoopResult

PLACE = "place.npz"
TRIES, PAUSE_S = 100, 0.02  # of a copy: the files of a map are replaced in milliseconds, even on a busy computer
_FIELDS = ("kf_id", "candidate_kf_id", "candidate_T_kf", "information", "matches", "inliers", "score")


def save_session(saved: SavedMap, place: LoopResult | None, folder: Path) -> None:
    """Write a session's part.

    Args:
        saved: its own map. place: where that lies in the saved map it continues; None: nowhere. folder: replaced.
    """
    beside: dict[str, bytes] = {PLACE: b""}
    if place is not None:
        buffer = io.BytesIO()
        fields: dict[str, Any] = {name: np.asarray(getattr(place, name)) for name in _FIELDS}
        np.savez(buffer, **fields)
        beside[PLACE] = buffer.getvalue()
    save_map(saved, folder, beside, compress=False, synced=False)  # what is made of it soon is


def load_place(folder: Path) -> LoopResult | None:
    """Where the session of a folder lies in the saved map that it continues.

    Raises:
        StereoSfmError: the file is damaged.
    """
    try:
        raw = read_bytes(folder / PLACE)
        if not raw:
            return None
        data = read_arrays(raw)
        fields: dict[str, Any] = {name: data[name] if data[name].ndim else data[name].item() for name in _FIELDS}
        return LoopResult(**fields, reason="")
    except (OSError, KeyError, ValueError, TypeError):
        raise StereoSfmError(f"{folder} is damaged: its {PLACE} cannot be read") from None


def publish(base: Path | None, session: Path, out: Path, config: Config) -> int:
    """Write the saved map that a session makes of the one it continues (`maps.update`), however often that happens.

    Args:
        base: the saved map that the session began with, None for none. session: of `save_session`.
        out: replaced by the result.
        config: of loops and mapping.

    Returns:
        Keyframes of the result.

    Raises:
        StereoSfmError: the session was not found in the saved map, or a folder is damaged; `out` stays as it is.
    """
    if base is None:
        copy_map(session, out)
        return read_header(out, ())["keyframes"]
    part = load_map(session)
    place = load_place(session)
    if place is None:
        raise StereoSfmError(f"the session was not found in the saved map {base} yet")
    vocabulary = configured_vocabulary(config.loop)
    saved = update(load_map(base), part, vocabulary, config.loop, config.mapper, place).saved
    save_map(saved, out)
    return len(saved)


def copy_map(folder: Path, to: Path) -> None:
    """A copy of a map folder that does not change with it; it shares what saves replace where the disk can do that.

    Raises:
        StereoSfmError: no map, or one that is being replaced all the time.
    """
    for _ in range(TRIES):
        try:
            return _copy(folder, to)
        except FileNotFoundError:
            time.sleep(PAUSE_S)
    raise StereoSfmError(f"{folder} was not copied: it has no map, or is replaced again and again")


def _copy(folder: Path, to: Path) -> None:
    """Raises FileNotFoundError where the folder is replaced meanwhile."""
    before = content(folder)
    with replaced_folder(to, frozenset(before)) as draft:
        for name in before.keys() - {PLACE, COMPLETE}:
            if name in map_files():  # others, such as a plan, are written in place
                with contextlib.suppress(OSError):
                    os.link(folder / name, draft / name)
                    continue
            shutil.copy2(folder / name, draft / name)
        if not before or COMPLETE in before or content(folder) != before:
            raise FileNotFoundError(folder)
