"""The output folder of a run: its name, its files, and the link to the latest one."""

from __future__ import annotations

import json
import re
from datetime import datetime
from pathlib import Path

import numpy as np

from stereo_sfm.errors import StereoSfmError

TRAJECTORIES = ("trajectory_odom.tum", "trajectory_odom.kitti", "trajectory_map.tum", "trajectory_map.kitti")
PICTURES = ("trajectory.png", "errors.png", "tracking.png", "times.png")
NUMBERS = ("keyframes.tum", "config.toml", "rig.yaml", "stats.json", "report.md")
FILES = ("run.mcap", "run.rrd", *TRAJECTORIES, *NUMBERS, *PICTURES)


def default_folder(source_name: str, now: datetime) -> Path:
    """runs/2026-08-21_101500_store12."""
    slug = re.sub(r"[^A-Za-z0-9.-]+", "_", source_name.removesuffix(".mcap")).strip("_") or "run"
    return Path("runs") / f"{now:%Y-%m-%d_%H%M%S}_{slug}"


def is_free(folder: Path) -> bool:
    """Whether nothing is there, or an empty folder."""
    return not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))


def prepare_folder(folder: Path, overwrite: bool) -> None:
    """Make the folder of a new run; an empty one will do.

    With `overwrite` the files of an earlier run are removed, so that none of them is taken for this run's; whatever
    else lies there stays.

    Raises:
        StereoSfmError: it holds something that may not be overwritten, or cannot be made.
    """
    try:
        if not (overwrite or is_free(folder)):
            raise StereoSfmError(f"{folder} exists: choose another -o, or say --overwrite")
        folder.mkdir(parents=True, exist_ok=True)
        discard_files(folder)
    except OSError as error:
        raise StereoSfmError(f"cannot make the output folder {folder}: {error.strerror}") from None


def discard_files(folder: Path) -> None:
    """Remove the files of a run; whatever else lies there stays."""
    made_later = [*folder.glob("export_*"), *folder.glob("matches/*.png")]
    for path in [*(folder / name for name in FILES), *(path for path in made_later if path.is_file())]:
        path.unlink(missing_ok=True)


def link_latest(folder: Path) -> None:
    """Let `runs/latest` point to a folder in `runs`, where the file system has links."""
    link = folder.parent / "latest"
    if folder.parent.name != "runs" or (link.exists() and not link.is_symlink()):
        return
    try:
        link.unlink(missing_ok=True)
        link.symlink_to(folder.name, target_is_directory=True)
    except OSError:
        return


def write_json(path: Path, data: object) -> None:
    """Indented, floats as they are, numpy numbers as plain ones."""
    path.write_text(json.dumps(data, indent=2, default=_plain) + "\n", encoding="utf-8")


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} has no JSON form")
