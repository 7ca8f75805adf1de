"""Two folders of images as a kind of source; `stereo_sfm.drivers.images.source` reads them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.drivers.options import SourceOptions, option

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


@dataclass(frozen=True)
class ImagesOptions(SourceOptions):
    """Options of `images:FOLDER`."""

    left: str = option("", "folder of the left images, or a pattern of its files, if the names are unusual")
    right: str = option("", "folder of the right images, or a pattern of its files, if the names are unusual")
    fps: float | None = option(
        None, "frames a second, where neither names nor times.txt tell the stamps (30)", low=1e-3, high=1e5
    )


def _open(place: str, options: ImagesOptions) -> Source:
    from stereo_sfm.drivers.images.source import open_images

    return open_images(place, options)


def _recognise(path: Path) -> Certainty:
    from stereo_sfm.drivers.images.source import find_pair

    return Certainty.PERHAPS if path.is_dir() and find_pair(path) is not None else Certainty.NO


DRIVER = Driver(
    "two image folders (left/, right/) with a rig file", "FOLDER", ImagesOptions, _open, recognise=_recognise
)
