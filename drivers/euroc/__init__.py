"""EuRoC and TUM VI as kinds of sources; `stereo_sfm.drivers.euroc.source` reads both."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.drivers.options import SourceOptions

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


def _open_euroc(place: str, options: SourceOptions) -> Source:
    from stereo_sfm.drivers.euroc.source import open_euroc

    return open_euroc(place, options)


def _open_tum_vi(place: str, options: SourceOptions) -> Source:
    from stereo_sfm.drivers.euroc.source import open_tum_vi

    return open_tum_vi(place, options)


def _is_euroc(path: Path) -> Certainty:
    return Certainty.LAYOUT if any((path / p).is_dir() for p in ("mav0/cam0", "cam0/data")) else Certainty.NO


def _is_tum_vi(path: Path) -> Certainty:
    chain = any((path / p).is_file() for p in ("camchain.yaml", "dso/camchain.yaml"))
    return Certainty.MARKED if chain and (path / "mav0").is_dir() else Certainty.NO


EUROC = Driver("EuRoC, ASL: mav0/ with cam0, cam1", "FOLDER", SourceOptions, _open_euroc, recognise=_is_euroc)
TUM_VI = Driver(
    "TUM VI: mav0/ next to camchain.yaml (or dso/camchain.yaml)",
    "FOLDER",
    SourceOptions,
    _open_tum_vi,
    recognise=_is_tum_vi,
)
