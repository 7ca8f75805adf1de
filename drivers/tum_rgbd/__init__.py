"""TUM RGB-D as a kind of source; `stereo_sfm.drivers.tum_rgbd.source` reads it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.drivers.options import SourceOptions, option

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


@dataclass(frozen=True)
class TumRgbdOptions(SourceOptions):
    """Options of `tum_rgbd:FOLDER`."""

    depth_scale: float = option(
        5000.0, "stored units of a depth image per metre (1000: millimetres)", low=1e-3, high=1e6
    )


def _open(place: str, options: TumRgbdOptions) -> Source:
    from stereo_sfm.drivers.tum_rgbd.source import open_tum_rgbd

    return open_tum_rgbd(place, options)


def _recognise(path: Path) -> Certainty:
    lists = (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()
    return Certainty.LAYOUT if lists else Certainty.NO


DRIVER = Driver("TUM RGB-D: rgb.txt, depth.txt", "FOLDER", TumRgbdOptions, _open, recognise=_recognise)
