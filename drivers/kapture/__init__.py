"""kapture folders as a kind of source; `stereo_sfm.drivers.kapture.source` reads them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.drivers.options import SourceOptions

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


def _open(place: str, options: SourceOptions) -> Source:
    from stereo_sfm.drivers.kapture.source import open_kapture

    return open_kapture(place, options)


def _recognise(path: Path) -> Certainty:
    marked = any((path / p).is_file() for p in ("kapture_sensors.txt", "sensors/sensors.txt"))
    return Certainty.MARKED if marked else Certainty.NO


DRIVER = Driver(
    "kapture: kapture_sensors.txt or sensors/sensors.txt", "FOLDER", SourceOptions, _open, recognise=_recognise
)
