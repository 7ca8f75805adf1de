"""The folders of a long recording in segments.

    ROOT/00007_2026-11-22_151400/      a recording; numbers only grow, so that a wrong clock changes no order
        recording.json                 source, mode and beginning
        00012_000720.mcap              segment 12, from second 720 on: poses, keyframes, map updates, events, thumbnails
        00012_000720.images.mcap       its images with inertial and wheel samples: a recording of its own
        SHA256SUMS                     of the files that have arrived in a bucket (`recording.upload`)
        00012_000720.marked            kept beyond the quota; a line for each mark, "lost: ..." of the service's own

Each file opens alone; the folder is a source that plays the images of all its segments.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import re
import shutil
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from stereo_sfm.drivers.mcap import IMAGES, RECORDING
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import open_regular, read_bytes, read_json
from stereo_sfm.log import topics
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.scan import summary_is_whole
from stereo_sfm.storage.folders import read_sums

KIND = "stereo_sfm_recording"
POSES, MARKED = ".mcap", ".marked"
SENT = "SHA256SUMS"  # of a recording: its files that are in a bucket, with their checksums
SENT_END = b"# complete\n"  # its last line when all are there
AUTOMATIC = "lost: "  # a mark that begins like this is the service's own
_FOLDER = re.compile(r"(\d{5,})_[\d_-]+")
_SEGMENT = re.compile(r"(\d{5,})_(\d{6,})[a-z]*")  # letters: begun again after the disk refused a file


@dataclass(frozen=True)
class Segment:
    """One segment on disk."""

    folder: Path
    name: str  # NUMBER_SECOND

    @staticmethod
    def of(folder: Path, number: int, second: int) -> Segment:
        """The segment with this number that begins in this second of its recording."""
        return Segment(folder, f"{number:05d}_{second:06d}")

    @property
    def second(self) -> int:
        """Of its recording, when it began."""
        return int(self.name.partition("_")[2].rstrip("abcdefghijklmnopqrstuvwxyz"))

    @property
    def poses(self) -> Path:
        return self.folder / f"{self.name}{POSES}"

    @property
    def images(self) -> Path:
        return self.folder / f"{self.name}{IMAGES}"

    @property
    def mark_file(self) -> Path:
        return self.folder / f"{self.name}{MARKED}"

    @property
    def marked(self) -> bool:
        """Whether it is kept, by a person or by the service itself."""
        return self.mark_file.exists()

    @property
    def marked_by_hand(self) -> bool:
        """Whether a person marked it."""
        try:
            lines = read_bytes(self.mark_file).decode(errors="replace").splitlines()
        except FileNotFoundError:
            return False
        except OSError:
            return True
        return not lines or not all(line.startswith(AUTOMATIC) for line in lines)

    def unsent(self, black_box: bool = False) -> list[Path]:
        """Its files that are to be in a bucket and are not there yet: of a black box, images of marked ones alone."""
        names = read_sums(sent_lines(self.folder).decode(errors="replace"))
        wanted = [self.poses] if black_box and not self.marked else [self.poses, self.images, self.mark_file]
        return [path for path in wanted if path.name not in names and path.is_file()]

    @property
    def bytes(self) -> int:
        """On disk."""
        return _size(self.poses) + _size(self.images)

    def mark(self, text: str) -> None:
        """Keep it. The service's own mark is written once: more of them say nothing more."""
        if text.startswith(AUTOMATIC) and self.marked:
            return
        with self.mark_file.open("a", encoding="utf-8") as file:
            file.write(f"{text}\n")

    def delete(self) -> None:
        """Remove it, and its recording with the last of its segments."""
        for path in (self.images, self.poses, self.mark_file):
            path.unlink(missing_ok=True)
        if not segments(self.folder):
            if not sent_lines(self.folder) or sent_whole(self.folder):  # else its checksums are still to be sent
                for name in (RECORDING, SENT):
                    (self.folder / name).unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # it holds other files
                self.folder.rmdir()


_not_written: dict[Path, bytes] = {}  # lines of SHA256SUMS that the disk did not take, by recording


def sent_lines(folder: Path) -> bytes:
    """The SHA256SUMS of a recording: its files that are in a bucket; empty where there are none."""
    try:
        written = read_bytes(folder / SENT)
    except OSError:
        written = b""
    return written + _not_written.get(folder, b"")


def add_sent(folder: Path, lines: bytes) -> None:
    """Add lines to the SHA256SUMS of a recording. What a full disk does not take, this process knows, and writes with
    the next lines: the quota can delete what is in a bucket, and nothing is sent twice."""
    lines = _not_written.get(folder, b"") + lines
    size = _size(folder / SENT)
    try:
        with (folder / SENT).open("ab") as stream:
            stream.write(lines)
        _not_written.pop(folder, None)
    except OSError:
        _not_written[folder] = lines
        with contextlib.suppress(OSError):  # no part of a line
            os.truncate(folder / SENT, size)


def sent_whole(folder: Path) -> bool:
    """Whether all of a recording is in a bucket, and its checksums with it."""
    return sent_lines(folder).endswith(SENT_END)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def recordings(root: Path) -> list[Path]:
    """The recordings in a folder, oldest first."""
    found = [path for path in root.glob("*_*") if _FOLDER.fullmatch(path.name) and path.is_dir()]
    return sorted(found, key=lambda path: (int(path.name.partition("_")[0]), path.name))


def segments(folder: Path) -> list[Segment]:
    """The segments of one recording, oldest first."""
    names = {path.name.partition(".")[0] for path in folder.glob("*.mcap")}
    found = [name for name in names if _SEGMENT.fullmatch(name)]
    return [Segment(folder, name) for name in sorted(found, key=lambda name: (int(name.partition("_")[0]), name))]


def new_recording(root: Path, source: str, mode: str, now: datetime) -> Path:
    """Make the folder of a new recording.

    Raises:
        OSError: it cannot be made.
    """
    root.mkdir(parents=True, exist_ok=True)
    last = recordings(root)
    number = int(last[-1].name.partition("_")[0]) + 1 if last else 1
    folder = root / f"{number:05d}_{now:%Y-%m-%d_%H%M%S}"
    folder.mkdir()
    try:
        describe(folder, source, mode, now)
    except OSError:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder


def describe(folder: Path, source: str, mode: str, began: datetime) -> None:
    """Write the recording.json of a folder, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    about = {"kind": KIND, "version": 1, "source": source, "mode": mode, "began": began.isoformat(timespec="seconds")}
    part = folder / f"{RECORDING}.part"
    try:
        part.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
        part.replace(folder / RECORDING)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def about(folder: Path) -> dict[str, Any]:
    """The content of recording.json; empty where it is missing or damaged."""
    try:
        data = read_json(folder / RECORDING)
    except (OSError, ValueError):
        return {}
    return data if isinstance(data, dict) and data.get("kind") == KIND else {}


def _seconds(folder: Path, last: Segment) -> int:
    """Length of a recording: by the poses of its last segment, by the clock of the disk where that has no end yet."""
    try:
        size, written_ns = last.poses.stat().st_size, last.poses.stat().st_mtime_ns
        length_s = _poses_s(last.poses, size, written_ns)
        if length_s is None:
            return max(last.second, round((written_ns - (folder / RECORDING).stat().st_mtime_ns) / 1e9))
        return round(last.second + length_s)
    except OSError:
        return last.second


@functools.lru_cache(maxsize=1000)
def _poses_s(path: Path, size: int, written_ns: int) -> float | None:
    """Seconds from the first to the last pose of a closed file; None for one that is being written, or cut off.

    Args: path; size and written_ns, of the file, so that each of its states is read once.
    """
    with open_regular(path) as stream:
        if not summary_is_whole(stream):
            return None
    try:
        with LogReader(path) as reader:
            stamps = reader.stamps(topics.FRAME)
    except StereoSfmError:
        return None
    return float(stamps[-1] - stamps[0]) / 1e9 if len(stamps) else 0.0


def listed(folder: Path) -> dict[str, str | int | bool]:
    """A recording in a list: plain values."""
    parts, head = segments(folder), about(folder)
    return {
        "id": folder.name,
        "began": str(head.get("began", "")),
        "source": str(head.get("source", "")),
        "mode": str(head.get("mode", "")),
        "seconds": _seconds(folder, parts[-1]) if parts else 0,
        "segments": len(parts),
        "with_images": sum(segment.images.exists() for segment in parts),
        "bytes": sum(segment.bytes for segment in parts),
        "marked": any(segment.marked for segment in parts),
    }


def delete_recording(root: Path, name: str) -> None:
    """Remove a whole recording.

    Raises:
        StereoSfmError: there is none of this name.
    """
    shutil.rmtree(find_recording(root, name))


def find_recording(root: Path, name: str) -> Path:
    """The folder of a recording by its name.

    Raises:
        StereoSfmError: there is none of this name.
    """
    for folder in recordings(root):
        if folder.name == name:
            return folder
    raise StereoSfmError(f"there is no recording '{name}'")
