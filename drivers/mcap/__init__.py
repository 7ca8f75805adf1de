"""MCAP files as a kind of source; see `drivers.mcap.source` for our own, `drivers.mcap.foreign` for other programs'."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.drivers.options import SourceOptions, option

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


# of a folder of segments, as `stereo_sfm.recording` writes it
RECORDING, IMAGES = "recording.json", ".images.mcap"


@dataclass(frozen=True)
class McapOptions(SourceOptions):
    """Options of `mcap:FILE`. The topics are for files of other programs."""

    left: str = option("", "topic of the left images, if the names are ambiguous")
    right: str = option("", "topic of the right images, if the names are ambiguous")
    depth: str = option("", "topic of the depth images, if the names are ambiguous")
    wheel: str = option("", "topic of wheel odometry: Odometry, TwistStamped or JointState")
    joints: str = option("", "the wheels' joints of a JointState, in the order of the rig: LEFT,RIGHT")


def _open(place: str, options: McapOptions) -> Source:
    from stereo_sfm.drivers.mcap.source import open_mcap

    folder = Path(place).expanduser()
    if place and folder.is_dir():
        from stereo_sfm.drivers.mcap.segments import SegmentsSource

        return SegmentsSource(folder, options)
    return open_mcap(place, options)


def _recognise(path: Path) -> Certainty:
    if (path / RECORDING).is_file() and any(path.glob("*.mcap")):
        return Certainty.MARKED
    if not path.is_file():
        return Certainty.NO
    return Certainty.MARKED if path.suffix == ".mcap" else Certainty.PERHAPS


DRIVER = Driver(
    "recordings and runs, and MCAP files of other programs", "FILE", McapOptions, _open, recognise=_recognise
)
