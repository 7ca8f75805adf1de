"""KITTI raw data as a kind of source; `stereo_sfm.drivers.kitti_raw.source` reads it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.drivers.options import SourceOptions, option
from stereo_sfm.input_file import visible

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


@dataclass(frozen=True)
class KittiRawOptions(SourceOptions):
    """Options of `kitti_raw:FOLDER`."""

    drive: str = option("", "which drive, if the folder is that of the date (0009)")


def _open(place: str, options: KittiRawOptions) -> Source:
    from stereo_sfm.drivers.kitti_raw.source import open_kitti_raw

    return open_kitti_raw(place, options)


def _recognise(path: Path) -> Certainty:
    drives = (path, *sorted(visible(path, "*_drive_*")))
    found = any((drive / f"image_0{i}" / "data").is_dir() for drive in drives for i in (0, 2))
    return Certainty.LAYOUT if found else Certainty.NO


DRIVER = Driver("KITTI raw data: a drive with image_00/data", "FOLDER", KittiRawOptions, _open, recognise=_recognise)
