"""ROS bags as a kind of source: rosbag2 folders and their files, and bags of ROS 1; see `drivers.rosbag.reader`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.drivers.mcap import McapOptions

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source

_MARK = "rosbag2_bagfile_information"  # first line of a rosbag2 folder's metadata.yaml
_MARK_BYTES = 4096


def _open(place: str, options: McapOptions) -> Source:
    from stereo_sfm.drivers.rosbag.reader import open_bag

    return open_bag(place, options)


def _recognise(path: Path) -> Certainty:
    if path.is_file():
        return Certainty.MARKED if path.suffix in (".bag", ".db3") else Certainty.NO
    about = path / "metadata.yaml"
    if not about.is_file():
        return Certainty.NO
    with about.open("rb") as file:
        return Certainty.MARKED if _MARK.encode() in file.read(_MARK_BYTES) else Certainty.NO


DRIVER = Driver("bags of ROS 2 and ROS 1", "FOLDER|FILE", McapOptions, _open, recognise=_recognise)
