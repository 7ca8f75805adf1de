"""TUM RGB-D as a kind of source; `stereo_sfm.drivers.tum_rgbd.source` reads it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.drivers.options import SourceOptions

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


def _open(place: str, options: SourceOptions) -> Source:
    from stereo_sfm.drivers.tum_rgbd.source import open_tum_rgbd

    return open_tum_rgbd(place, options)


def _recognise(path: Path) -> Certainty:
    lists = (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()
    return Certainty.LAYOUT if lists else Certainty.NO


DRIVER = Driver("TUM RGB-D: rgb.txt, depth.txt", "FOLDER", SourceOptions, _open, recognise=_recognise)
