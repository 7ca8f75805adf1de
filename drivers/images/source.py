"""Two folders of images (or one with left*/right* files) with a rig file: the simplest dataset format.

Stamps come from times.txt (a line for each frame, `drivers.times_file`), else from file names in nanoseconds or
seconds, else from the given frame rate and the numbers in the file names.
"""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.side_names import LEFT_RIGHT, side_pairs, words_of
from stereo_sfm.drivers.folder_source import FolderSource, FrameFiles, folder_of
from stereo_sfm.drivers.ground_truth import has_stamps, read_trajectory
from stereo_sfm.drivers.image_lists import (
    frame_numbers,
    lines_of,
    list_images,
    natural_key,
    pair_files,
    stamps_of,
    truth_of_lines,
)
from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.times_file import read_times
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import visible
from stereo_sfm.pixels import SUFFIXES

if TYPE_CHECKING:
    from stereo_sfm.drivers.images import ImagesOptions

ASSUMED_FPS = 30.0
# Words beside which numbers tell cameras apart (`calib.side_names`), and not recordings.
CAMERAS = {"cam", "camera", "image", "img", "im", "infra", "ir", "fisheye", "view", "rect", "sensor", "lens", "eye"}
TIMES = tuple(f"{name}{suffix}" for name in ("times", "timestamps", "timestamp") for suffix in (".txt", ".csv"))
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
    found = find_pair(folder, options.left, options.right)
    if found is None:
        there = ", ".join(sorted(p.name for p in visible(folder))[:8])
        raise StereoSfmError(
            f"{folder} contains no image pair (left/ and right/, cam0/ and cam1/, or left*, right* files) but {there}: "
            f"name them as in 'images:{path}?left=FOLDER&right=FOLDER'"
        )
    stamps = _stamps(name, folder, found[0], options.fps)
    pairs = [pair for pair in pair_files(name, *found) if pair[0] in stamps]
    skews = _skews(pairs)
    frames = [
        FrameFiles(stamps[left], left, right, right_stamp_ns=0 if skew is None else stamps[left] + skew)
        for (left, right), skew in zip(pairs, skews, strict=True)
    ]
    truth = next((folder / n for n in TRUTH_NAMES if (folder / n).is_file()), None)
    poses = None if truth is None else read_trajectory(truth)
    if truth is not None and poses is not None and not has_stamps(truth):
        poses = truth_of_lines(name, poses.poses, truth.name, found[0], stamps)
    source = FolderSource(name, chosen_rig(options.rig, lambda: _own_rig(folder)), frames, poses)
    if options.fps is None and not _stamped(folder, found[0]):
        source.assumed_hz = ASSUMED_FPS
    return source


def _stamped(folder: Path, files: list[Path]) -> bool:
    """Whether something tells when the images were taken."""
    return _times_file(folder) is not None or stamps_of(files) is not None


def find_pair(folder: Path, left: str = "", right: str = "") -> tuple[list[Path], list[Path]] | None:
    """The left and the right image files of a folder, in order; None if there is no such pair.

    Args:
        folder: with a folder for each camera, or with the files of both.
        left, right: a folder or a pattern of files ("left*.png") each, where the names do not tell.
    """
    if left or right:
        return _chosen(folder, left), _chosen(folder, right)
    inside = {
        p.name: place for p in sorted(visible(folder)) if p.is_dir() for place in (p, p / "data") if _has_images(place)
    }
    for names in _of_cameras(list(inside)):
        return list_images(inside[names[0]]), list_images(inside[names[1]])
    if not _has_images(folder):
        return None
    sides = _by_side(list_images(folder))
    for names in _of_cameras(list(sides)):
        return sides[names[0]], sides[names[1]]
    return None


def _of_cameras(names: list[str]) -> list[tuple[str, str]]:
    """Pairs of names, those of numbers beside a word for a camera only."""
    sides = {side for pair in LEFT_RIGHT for side in pair}
    return [
        pair for pair in side_pairs(names)
        if any(w in sides | CAMERAS or w.startswith("left") or w.endswith("left") for w in words_of(pair[0]))
    ]  # fmt: skip


def _chosen(folder: Path, text: str) -> list[Path]:
    """The files of one camera that the user names.

    Raises:
        StereoSfmError: there are none.
    """
    if text and (folder / text).is_dir():
        return list_images(folder / text)
    files = [p for p in visible(folder, text) if p.suffix.lower() in SUFFIXES] if text else []
    if not files:
        raise StereoSfmError(
            f"{folder}: '{text}' is no folder and no pattern of image files: give both left= and right="
        )
    return sorted(files, key=natural_key)


def _by_side(files: list[Path]) -> dict[str, list[Path]]:
    """Files of one folder by their names without the frame's number, the digits that differ most."""
    alike: dict[tuple[str, ...], list[tuple[Path, list[str]]]] = {}
    for path in files:
        parts = re.split(r"([0-9]+)", path.stem)
        alike.setdefault(tuple(parts[::2]), []).append((path, parts[1::2]))
    out: dict[str, list[Path]] = {}
    for words, rows in alike.items():
        counts = [len({digits[k] for _, digits in rows}) for k in range(len(words) - 1)]
        frame = max(range(len(counts)), key=lambda k, counts=counts: (counts[k], k), default=-1)
        for path, digits in rows:
            kept = [text if k != frame else "_" for k, text in enumerate(digits)]
            out.setdefault("".join(itertools.chain(*zip(words, [*kept, ""], strict=True))), []).append(path)
    return out


def _has_images(folder: Path) -> bool:
    return folder.is_dir() and any(p.suffix.lower() in SUFFIXES for p in visible(folder))


def _own_rig(folder: Path) -> Rig:
    from stereo_sfm.calib import load_rig

    candidates = [folder / f"{name}{suffix}" for name in RIG_NAMES for suffix in RIG_SUFFIXES]
    path = next((p for p in candidates if p.is_file()), None)
    if path is None:
        raise StereoSfmError(f"{folder} has no calibration (rig.yaml, calib.yaml, camchain.yaml, ...): give --rig FILE")
    return load_rig(path)


def _stamps(name: str, folder: Path, files: list[Path], fps: float | None) -> dict[Path, int]:
    """Nanoseconds of the left images."""
    path = _times_file(folder)
    if path is not None:
        times = read_times(path)
        named = dict(zip(times.names, times.stamp_ns, strict=False))
        if all(file.stem in named for file in files):
            return {file: named[file.stem] for file in files}
        lines = lines_of(name, files, len(times.stamp_ns), path.name)
        return {file: times.stamp_ns[line] for file, line in lines.items()}
    stamps = stamps_of(files)
    if stamps is not None:
        return dict(zip(files, stamps, strict=True))
    period = 1e9 / (fps or ASSUMED_FPS)
    return {p: round(i * period) for p, i in zip(files, frame_numbers(files), strict=True)}


def _times_file(folder: Path) -> Path | None:
    return next((folder / name for name in TIMES if (folder / name).is_file()), None)


def _skews(pairs: list[tuple[Path, Path]]) -> list[int | None]:
    """Nanoseconds from the left to the right stamp of each pair where the names are times."""
    left, right = [a for a, _ in pairs], [b for _, b in pairs]
    stamps_left, stamps_right = stamps_of(left), stamps_of(right, left)
    if stamps_left is None or stamps_right is None:
        return [None] * len(pairs)
    return [b - a for a, b in zip(stamps_left, stamps_right, strict=True)]
