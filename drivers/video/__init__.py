"""Videos of two cameras as a kind of source; `stereo_sfm.drivers.video.source` reads them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.drivers.options import SourceOptions, option
from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source

SUFFIXES = (".mp4", ".mkv", ".avi", ".mov", ".webm", ".m4v")


@dataclass(frozen=True)
class VideoOptions(SourceOptions):
    """Options of `video:FILE`. Both images of one file lie side by side or one above the other: their size tells."""

    right: str = option("", "file of the right camera, where each has its own", file=True)
    swap: bool = option(False, "the right image comes first")
    fps: float | None = option(None, "frames a second, where the file's times are wrong", low=1e-3, high=1e5)


def _open(place: str, options: VideoOptions) -> Source:
    from stereo_sfm.drivers.video.source import VideoSource

    return VideoSource(place, options)


def _check(place: str, options: VideoOptions) -> None:
    if not place:
        raise StereoSfmError("no file given: use video:FILE.mp4")


def _recognise(path: Path) -> Certainty:
    return Certainty.MARKED if path.is_file() and path.suffix.lower() in SUFFIXES else Certainty.NO


DRIVER = Driver(
    "videos of two cameras: side by side, one above the other, or two files, with a rig file", "FILE", VideoOptions,
    _open, _check, recognise=_recognise,
)  # fmt: skip
