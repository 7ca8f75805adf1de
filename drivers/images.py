"""Two folders of images (or one with left*/right* files) with a rig file: the form anybody can bring.

Stamps come from file names that are nanoseconds or seconds, else from times.txt (a line of seconds a frame), else from
the frame rate given.
"""

from __future__ import annotations

from pathlib import Path

from calib.rig import Rig
from drivers.folder_source import IMAGE_SUFFIXES, FolderSource, Shot, folder_of, list_images, pair_in_order
from drivers.ground_truth import read_trajectory, stamp_from_seconds
from drivers.rig_option import RigOption, chosen_rig
from stereo_sfm.errors import StereoSfmError

EARLIEST_NS = 10**17  # file names that are times are after 1973; smaller numbers count frames
# folder names of the two eyes; the first two are also file name prefixes in one folder
PAIRS = (("left", "right"), ("cam0", "cam1"), ("image_0", "image_1"), ("image_2", "image_3"), ("infra1", "infra2"))
RIG_NAMES = ("rig", "calibration", "calib", "camchain", "stereo", "intrinsics")
RIG_SUFFIXES = (".yaml", ".yml", ".json", ".txt")
TRUTH_NAMES = ("groundtruth.txt", "groundtruth.tum", "poses.tum", "poses.txt")


def open_images(path: str, rig: RigOption = None, fps: float | str = 30.0) -> FolderSource:
    """Open a pair of image folders.

    Args:
        path: the folder that holds both.
        rig: a rig or rig file; without it the one found in the folder (rig.yaml, calib.yaml, ...).
        fps: frames a second, used where nothing tells the stamps.
    """
    folder = folder_of("images", path)
    name = f"images:{folder.resolve().name}"
    found = find_pair(folder)
    if found is None:
        raise StereoSfmError(
            f"{folder} holds no image pair (left/ and right/, cam0/ and cam1/, or left*, right* files)"
        )
    pairs = pair_in_order(name, *found)
    stamps = _stamps(folder, [left for left, _ in pairs], fps)
    shots = [Shot(stamp, left, right) for stamp, (left, right) in zip(stamps, pairs, strict=True)]
    truth = next((folder / n for n in TRUTH_NAMES if (folder / n).is_file()), None)
    return FolderSource(
        name,
        chosen_rig(rig, lambda: _own_rig(folder)),
        shots,
        read_trajectory(truth) if truth is not None else None,
    )


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
    return folder.is_dir() and any(p.suffix.lower() in IMAGE_SUFFIXES for p in folder.iterdir())


def _own_rig(folder: Path) -> Rig:
    from calib import load_rig

    candidates = [folder / f"{name}{suffix}" for name in RIG_NAMES for suffix in RIG_SUFFIXES]
    path = next((p for p in candidates if p.is_file()), None)
    if path is None:
        raise StereoSfmError(f"{folder} has no calibration (rig.yaml, calib.yaml, camchain.yaml, ...): give --rig FILE")
    return load_rig(path)


def _stamps(folder: Path, files: list[Path], fps: float | str) -> list[int]:
    """Strictly ascending nanoseconds, one for each file."""
    times = folder / "times.txt"
    if times.is_file():
        stamps = [stamp_from_text(line) for line in times.read_text("utf-8-sig").split()]
        if len(stamps) < len(files) or None in stamps:
            raise StereoSfmError(f"{times} must hold one time in seconds for each of the {len(files)} frames")
        return [s for s in stamps if s is not None][: len(files)]
    named = [stamp_from_text(p.stem) for p in files]
    if all(s is not None and s > EARLIEST_NS for s in named):
        return [s for s in named if s is not None]
    try:
        period = 1e9 / float(fps)
    except (ValueError, ZeroDivisionError):
        raise StereoSfmError(f"fps must be a number above 0, got '{fps}'") from None
    return [round(i * period) for i in range(len(files))]


def stamp_from_text(text: str) -> int | None:
    """Nanoseconds from '1403636579763555584' or '1305031102.175304'; None if it is neither."""
    if text.isdigit() and len(text) >= 15:
        return int(text)
    try:
        return stamp_from_seconds(text)
    except ValueError:
        return None
