"""Files of a left and a right camera beside each other, by their names: left.yaml and right.yaml, infra1 and infra2."""

from __future__ import annotations

from pathlib import Path

from stereo_sfm.calib.side_names import side_pairs
from stereo_sfm.input_file import visible


def partner(left: Path) -> Path | None:
    """The right camera's file of a left camera's, None where there is none."""
    return next((right for first, right in _pairs(left.parent, left.suffix) if first.name == left.name), None)


def left_files(folder: Path, *suffixes: str) -> list[Path]:
    """Files of a folder that have a partner, the most certain first."""
    return [left for suffix in suffixes for left, _ in _pairs(folder, suffix)]


def _pairs(folder: Path, suffix: str) -> list[tuple[Path, Path]]:
    files = {p.stem: p for p in sorted(visible(folder)) if p.suffix == suffix and p.is_file()}
    return [(files[a], files[b]) for a, b in side_pairs(list(files))]
