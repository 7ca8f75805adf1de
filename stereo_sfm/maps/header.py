"""`map.json`, the header of a saved map, validated field by field."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import read_json

VERSION = 5  # 1 had no corners, 2 none in views that face the shelves, 3 no gravity, 4 one rig for all sessions
KIND = "stereo_sfm_map"
COUNTS = ("keyframes", "points", "observations", "sessions")


def damaged(folder: Path, what: str) -> StereoSfmError:
    """The error of a map folder that was changed after saving."""
    return StereoSfmError(f"the map {folder} is damaged: {what}; save it again")


def checksum(raw: bytes) -> str:
    """The checksum as written in map.json."""
    return hashlib.sha256(raw).hexdigest()


def write_header(folder: Path, counts: dict[str, int], vocabulary_id: str, checksums: dict[str, str]) -> None:
    """Write map.json with the row counts and the checksums of the files, by name."""
    head = {"kind": KIND, "version": VERSION, **counts, "vocabulary": vocabulary_id, "sha256": checksums}
    (folder / "map.json").write_text(json.dumps(head, indent=1) + "\n", encoding="utf-8")


def read_header(folder: Path, files: tuple[str, ...]) -> dict[str, Any]:
    """The fields of map.json.

    Args:
        folder: of the map.
        files: names that must have a checksum.

    Raises:
        StereoSfmError: no map, another version, or a missing or invalid field.
    """
    path = folder / "map.json"
    if not path.is_file():
        raise StereoSfmError(f"no map at {folder}: there is no map.json (create one with 'run ... --map-out')")
    try:
        head = read_json(path)
        version = head["version"] if head["kind"] == KIND else None
    except (ValueError, KeyError, TypeError, OSError):
        raise damaged(folder, "map.json cannot be read") from None
    if version not in range(2, VERSION + 1):
        raise StereoSfmError(
            f"the map {folder} is version {version}, this program reads version {VERSION}: make the map again, or "
            "use the stereo-sfm that wrote it"
        )
    for name in COUNTS:
        if type(head.get(name)) is not int or head[name] < 0:
            raise damaged(folder, f"map.json has no number '{name}'")
    if not isinstance(head.get("vocabulary"), str):
        raise damaged(folder, "map.json has no text 'vocabulary'")
    checksums = head.get("sha256")
    if not isinstance(checksums, dict) or not all(isinstance(checksums.get(name), str) for name in files):
        raise damaged(folder, "map.json lacks checksums")
    return head
