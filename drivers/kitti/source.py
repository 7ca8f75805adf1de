"""KITTI odometry: `sequences/NN` with calib.txt, times.txt, image_0 and image_1 (or the colour pair), `poses/NN.txt`.

Layout and conventions: Geiger et al., CVPR 2012, and the odometry development kit. Poses are those of grey camera 0,
which is the body of the rig here.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stereo_sfm.calib.formats.kitti import read_kitti as read_rig
from stereo_sfm.drivers.folder_source import FolderSource, FrameFiles, folder_of, need
from stereo_sfm.drivers.ground_truth import moved, read_kitti, stamp_from_seconds
from stereo_sfm.drivers.image_lists import lines_of, list_images, pair_files, truth_of_lines
from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.text_file import read_text
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import Trajectory

if TYPE_CHECKING:
    from stereo_sfm.drivers.kitti import KittiOptions

log = logging.getLogger("stereo_sfm")

PERIOD_NS = 100_000_000  # 10 Hz, where times.txt is missing


def open_kitti(path: str, options: KittiOptions) -> FolderSource:
    """Open one sequence.

    Args:
        path: the sequence's folder, or the data set's root.
        options: which sequence, and the calibration.
    """
    folder = _sequence_folder(folder_of("kitti", path), options.sequence)
    name = f"kitti:{folder.resolve().name}"
    sides = next((pair for pair in ((0, 1), (2, 3)) if (folder / f"image_{pair[0]}").is_dir()), None)
    if sides is None:
        raise StereoSfmError(f"{folder} has neither image_0 nor image_2")
    lefts, rights = (list_images(folder / f"image_{i}") for i in sides)
    stamps = _read_times(folder / "times.txt", name, len(lefts))
    line = lines_of(name, lefts, len(stamps), "times.txt", first=0)
    frames = [
        FrameFiles(stamps[line[left]], left, right) for left, right in pair_files(name, lefts, rights) if left in line
    ]
    chosen = chosen_rig(options.rig, lambda: read_rig(need(folder / "calib.txt", "KITTI calibration"), pair=sides))
    truth_file = folder.resolve().parent.parent / "poses" / f"{folder.resolve().name}.txt"
    truth = read_kitti(truth_file) if truth_file.is_file() else None
    if truth is not None and len(truth) == len(stamps):
        truth = Trajectory(np.array(stamps, np.int64), truth.poses)
    elif truth is not None:  # of the whole sequence, where the images are a part
        at = {left: stamps[k] for left, k in line.items()}
        truth = truth_of_lines(name, truth.poses, truth_file.name, lefts, at, first=0)
    return FolderSource(name, chosen, frames, None if truth is None else moved(truth, chosen.body_T_left))


def _sequence_folder(folder: Path, sequence: str) -> Path:
    if any((folder / f"image_{i}").is_dir() for i in (0, 2)):
        return folder
    root = next((folder / p for p in ("sequences", "dataset/sequences") if (folder / p).is_dir()), folder)
    if sequence:
        return folder_of("kitti", str(root / sequence))
    found = sorted(p.name for p in root.iterdir() if any((p / f"image_{i}").is_dir() for i in (0, 2)))
    if len(found) == 1:
        return root / found[0]
    if not found:
        raise StereoSfmError(f"{root} contains no KITTI sequence (a folder with image_0 and image_1)")
    raise StereoSfmError(f"{folder} contains sequences {', '.join(found)}: choose one, as in {root / found[0]}")


def _read_times(path: Path, name: str, count: int) -> list[int]:
    """Stamps in ns, one per line; `count` stamps at 10 Hz without a file."""
    if not path.is_file():
        log.warning("%s: no times.txt, frames are stamped at 10 Hz", name)
        return [i * PERIOD_NS for i in range(count)]
    try:
        return [stamp_from_seconds(line) for line in read_text(path).split()]
    except ValueError as error:
        raise StereoSfmError(f"{path}: {error}") from None
