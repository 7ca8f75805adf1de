"""KITTI odometry as a kind of source; `stereo_sfm.drivers.kitti.source` reads it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.drivers.options import SourceOptions, option

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


@dataclass(frozen=True)
class KittiOptions(SourceOptions):
    """Options of `kitti:FOLDER`."""

    sequence: str = option("", "which sequence, if the folder is the root of the dataset (00)")


def _open(place: str, options: KittiOptions) -> Source:
    from stereo_sfm.drivers.kitti.source import open_kitti

    return open_kitti(place, options)


def _recognise(path: Path) -> Certainty:
    if any((path / p).is_dir() for p in ("sequences", "dataset/sequences")):
        return Certainty.LAYOUT
    sequences = (path, *sorted(path.glob("[0-9][0-9]")))
    found = any((s / "calib.txt").is_file() and (s / f"image_{i}").is_dir() for s in sequences for i in (0, 2))
    return Certainty.LAYOUT if found else Certainty.NO


DRIVER = Driver(
    "KITTI odometry: sequences/NN with image_0, image_1", "FOLDER", KittiOptions, _open, recognise=_recognise
)
