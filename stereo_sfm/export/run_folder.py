"""The output folder of a run: its name, its files, and the link to the latest one."""

from __future__ import annotations

import json
import re
from datetime import datetime
from pathlib import Path

import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.folder_lock import FolderLock

TRAJECTORIES = ("trajectory_odom.tum", "trajectory_odom.kitti", "trajectory_map.tum", "trajectory_map.kitti")
PLOTS = ("trajectory.png", "errors.png", "tracking.png", "calibration.png", "times.png")
CORRECTED = "rig_corrected.yaml"
NUMBERS = ("keyframes.tum", "config.toml", "rig.yaml", CORRECTED, "stats.json", "report.md", "report.html")
KEPT_MAP = "map"  # subfolder with the run's own map
FILES = ("run.mcap", "run.rrd", *TRAJECTORIES, *NUMBERS, *PLOTS)


def default_folder(source_name: str, now: datetime) -> Path:
    """runs/2026-08-21_101500_store12."""
    slug = re.sub(r"[^A-Za-z0-9.-]+", "_", source_name.removesuffix(".mcap")).strip("_") or "run"
    return Path("runs") / f"{now:%Y-%m-%d_%H%M%S}_{slug}"


def is_free(folder: Path) -> bool:
    """Whether the path does not exist or is an empty folder."""
    return not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))


def refuse_taken(folder: Path, overwrite: bool) -> None:
    """Raises StereoSfmError for a folder that is not empty, without `overwrite`."""
    if not (overwrite or is_free(folder)):
        raise StereoSfmError(f"{folder} exists: choose another -o, or add --overwrite")


def prepare_folder(folder: Path, overwrite: bool) -> FolderLock:
    """Create the folder of a new run, or take an empty one, and lock it.

    With `overwrite` the files of an earlier run are removed, other files stay.

    Raises:
        StereoSfmError: it is not empty, locked by another run, or cannot be created.
    """
    try:
        refuse_taken(folder, overwrite)
        folder.mkdir(parents=True, exist_ok=True)
        lock = FolderLock(folder, "choose another -o, or wait for its end")
        discard_files(folder)
        return lock
    except OSError as error:
        raise StereoSfmError(f"cannot create the output folder {folder}: {error.strerror}") from None


def discard_files(folder: Path) -> None:
    """Remove the files of a run; other files stay."""
    made_later = [*folder.glob("export_*"), *folder.glob("matches/*.png")]
    if (folder / KEPT_MAP / "map.json").is_file():
        from stereo_sfm.maps.saved_map import map_files

        made_later += [folder / KEPT_MAP / name for name in map_files()]
    for path in [*(folder / name for name in FILES), *(path for path in made_later if path.is_file())]:
        path.unlink(missing_ok=True)


def link_latest(folder: Path) -> None:
    """Point `runs/latest` to a folder in `runs`, if the file system supports links."""
    link = folder.parent / "latest"
    if folder.parent.name != "runs" or (link.exists() and not link.is_symlink()):
        return
    try:
        link.unlink(missing_ok=True)
        link.symlink_to(folder.name, target_is_directory=True)
    except OSError:
        return


def write_json(path: Path, data: object) -> None:
    """Indented JSON; numpy scalars become plain numbers."""
    path.write_text(json.dumps(data, indent=2, default=_plain) + "\n", encoding="utf-8")


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not JSON serializable")
