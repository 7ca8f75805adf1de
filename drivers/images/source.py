"""Two folders of images (or one with left*/right* files) with a rig file: the simplest dataset format.

Stamps come from times.txt (seconds, one line per frame), else from file names in nanoseconds or seconds, else from the
given frame rate and the numbers in the file names.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.folder_source import FolderSource, FrameFiles, folder_of
from stereo_sfm.drivers.ground_truth import read_trajectory
from stereo_sfm.drivers.image_lists import (
    frame_numbers,
    lines_of,
    list_images,
    pair_files,
    stamp_from_text,
    stamps_of,
)
from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.text_file import read_text
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.pixels import SUFFIXES

if TYPE_CHECKING:
    from stereo_sfm.drivers.images import ImagesOptions

ASSUMED_FPS = 30.0
# folder names of the two cameras; the first two are also file name prefixes in one folder
PAIRS = (("left", "right"), ("cam0", "cam1"), ("image_0", "image_1"), ("image_2", "image_3"), ("infra1", "infra2"))
RIG_NAMES = ("rig", "calibration", "calib", "camchain", "stereo", "intrinsics")
RIG_SUFFIXES = (".yaml", ".yml", ".json", ".txt")
TRUTH_NAMES = ("groundtruth.txt", "groundtruth.tum", "poses.tum", "poses.txt")


def open_images(path: str, options: ImagesOptions) -> FolderSource:
    """Open a pair of image folders.

    Args:
        path: the folder with both.
        options: the frame rate, used where nothing tells the stamps, and the calibration; without it the one found in
            the folder (rig.yaml, calib.yaml, ...).
    """
    folder = folder_of("images", path)
    name = f"images:{folder.resolve().name}"
    found = find_pair(folder)
    if found is None:
        raise StereoSfmError(
            f"{folder} contains no image pair (left/ and right/, cam0/ and cam1/, or left*, right* files)"
        )
    stamps = _stamps(name, folder, found[0], options.fps)
    pairs = [pair for pair in pair_files(name, *found) if pair[0] in stamps]
    skews = _skews(pairs)
    frames = [
        FrameFiles(stamps[left], left, right, right_stamp_ns=0 if skew is None else stamps[left] + skew)
        for (left, right), skew in zip(pairs, skews, strict=True)
    ]
    truth = next((folder / n for n in TRUTH_NAMES if (folder / n).is_file()), None)
    source = FolderSource(
        name,
        chosen_rig(options.rig, lambda: _own_rig(folder)),
        frames,
        read_trajectory(truth) if truth is not None else None,
    )
    if options.fps is None and not _stamped(folder, found[0]):
        source.assumed_hz = ASSUMED_FPS
    return source


def _stamped(folder: Path, files: list[Path]) -> bool:
    """Whether something tells when the images were taken."""
    return (folder / "times.txt").is_file() or stamps_of(files) is not None


def find_pair(folder: Path) -> tuple[list[Path], list[Path]] | None:
    """The left and the right image files of a folder, in order; None if there is no such pair."""
    for names in PAIRS:
        sides = [next((p for p in (folder / n, folder / n / "data") if _has_images(p)), None) for n in names]
        if sides[0] is not None and sides[1] is not None:
            return list_images(sides[0]), list_images(sides[1])
    if not _has_images(folder):
        return None
    files = list_images(folder)
    left, right = ([p for p in files if _is_numbered(p.stem, prefix)] for prefix in PAIRS[0])
    return (left, right) if left and right else None


def _is_numbered(stem: str, prefix: str) -> bool:
    return stem.startswith(prefix) and stem[len(prefix) :].strip("_-").isdigit()


def _has_images(folder: Path) -> bool:
    return folder.is_dir() and any(p.suffix.lower() in SUFFIXES for p in folder.iterdir())


def _own_rig(folder: Path) -> Rig:
    from stereo_sfm.calib import load_rig

    candidates = [folder / f"{name}{suffix}" for name in RIG_NAMES for suffix in RIG_SUFFIXES]
    path = next((p for p in candidates if p.is_file()), None)
    if path is None:
        raise StereoSfmError(f"{folder} has no calibration (rig.yaml, calib.yaml, camchain.yaml, ...): give --rig FILE")
    return load_rig(path)


def _stamps(name: str, folder: Path, files: list[Path], fps: float | None) -> dict[Path, int]:
    """Nanoseconds of the left images."""
    times = folder / "times.txt"
    if times.is_file():
        stamps = [stamp_from_text(line) for line in read_text(times).split()]
        if None in stamps:
            raise StereoSfmError(f"{times} must have one time in seconds for each of the {len(files)} frames")
        lines = lines_of(name, files, len(stamps), times.name)
        return {file: stamps[line] or 0 for file, line in lines.items()}
    named = stamps_of(files)
    if named is not None:
        return dict(zip(files, named, strict=True))
    period = 1e9 / (fps or ASSUMED_FPS)
    return {p: round(i * period) for p, i in zip(files, frame_numbers(files), strict=True)}


def _skews(pairs: list[tuple[Path, Path]]) -> list[int | None]:
    """Nanoseconds from the left to the right stamp of each pair where the names are times."""
    left, right = [a for a, _ in pairs], [b for _, b in pairs]
    stamps_left, stamps_right = stamps_of(left), stamps_of(right, left)
    if stamps_left is None or stamps_right is None:
        return [None] * len(pairs)
    return [b - a for a, b in zip(stamps_left, stamps_right, strict=True)]
