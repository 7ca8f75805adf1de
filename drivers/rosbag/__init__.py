"""ROS bags as a kind of source: rosbag2 folders and their files, and bags of ROS 1; see `drivers.rosbag.reader`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.drivers.mcap import RECORDING, McapOptions
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import open_regular, visible

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source

_MARK = "rosbag2_bagfile_information"  # first line of a rosbag2 folder's metadata.yaml
_MARK_BYTES = 4096


def _open(place: str, options: McapOptions) -> Source:
    from stereo_sfm.drivers.rosbag.reader import open_bag

    folder = Path(place).expanduser()
    files = _files(folder) if place and folder.is_dir() and not (folder / "metadata.yaml").is_file() else []
    if len(files) > 1:
        raise StereoSfmError(
            f"{place} has {len(files)} files and no metadata.yaml: 'ros2 bag reindex {place}' makes one of the "
            f"parts of a bag; of recordings name one, such as {files[0]}"
        )
    if files and files[0].suffix == ".mcap":
        from stereo_sfm.drivers.mcap.source import open_mcap

        return open_mcap(str(files[0]), options)
    return open_bag(str(files[0]) if files else place, options)


def _files(folder: Path) -> list[Path]:
    """The files of a rosbag2 folder."""
    return sorted(p for p in visible(folder) if p.suffix in (".db3", ".mcap"))


def _recognise(path: Path) -> Certainty:
    if path.is_file():
        return Certainty.MARKED if path.suffix in (".bag", ".db3") else Certainty.NO
    if not path.is_dir():
        return Certainty.NO
    about = path / "metadata.yaml"
    if not about.is_file():
        ours = (path / RECORDING).is_file()
        return Certainty.NO if ours or not _files(path) else Certainty.LAYOUT
    with open_regular(about) as file:
        return Certainty.MARKED if _MARK.encode() in file.read(_MARK_BYTES) else Certainty.NO


DRIVER = Driver("bags of ROS 2 and ROS 1", "FOLDER|FILE", McapOptions, _open, recognise=_recognise)
