"""The driver interface: how a kind of source is named, recognised, found and opened.

A driver registers one `Driver` under the entry point group `stereo_sfm.drivers`; the entry point's name is the kind
that users write ("t265", "kitti"). The module of the entry point is imported to list the drivers: it imports nothing
heavy, and its `open` imports what reads images.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Generic

from stereo_sfm.drivers.options import O

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


class Certainty(enum.IntEnum):
    """A driver's confidence that a file or folder is of its kind; the most confident driver opens it."""

    NO = 0
    PERHAPS = 1  # readable, but not specific
    LAYOUT = 2  # the layout of this kind
    MARKED = 3  # explicitly marked by a file


@dataclass(frozen=True)
class UsbId:
    """Which USB devices a driver opens: a vendor's one product, or all of them."""

    vendor: int
    product: int | None = None


@dataclass(frozen=True)
class Attached:
    """One camera."""

    id: str  # what `run` and `record` take
    driver: str
    serial: str = ""
    usb_speed: str = ""
    firmware: str = ""
    calibrated: bool | None = None  # None: not known without starting the camera
    note: str = ""


@dataclass(frozen=True)
class Cameras:
    """Additional description of live cameras, used by `devices` and `udev`.

    Attributes:
        title: readable name of a camera ("T265").
        find: the cameras that are attached; with True, cameras may be started for more information.
            Raises `stereo_sfm.drivers.live.errors.DeviceError` when it cannot search. None: the driver cannot search.
        usb: devices that the udev rules make accessible.
        without: a source of this kind that needs no camera ("t265:simulated"), "" when there is none.
    """

    title: str
    find: Callable[[bool], Sequence[Attached]] | None = None
    usb: tuple[UsbId, ...] = ()
    without: str = ""


def _nothing(place: str, options: object) -> None:
    return None


def _not_mine(path: Path) -> Certainty:
    return Certainty.NO


@dataclass(frozen=True)
class Driver(Generic[O]):
    """One kind of source.

    Attributes:
        summary: what it reads, one line.
        place: what follows the colon, for help ("FOLDER", "[SERIAL]").
        options: its options: a frozen dataclass that inherits from `SourceOptions`.
        open: the source at a place, not yet entered. Raises StereoSfmError for user errors.
        check: raises StereoSfmError for an invalid place or options, without opening anything.
        recognise: whether an existing file or folder is of this kind.
        cameras: of a driver of live cameras; None for files.
    """

    summary: str
    place: str
    options: type[O]
    open: Callable[[str, O], Source]
    check: Callable[[str, O], None] = _nothing
    recognise: Callable[[Path], Certainty] = _not_mine
    cameras: Cameras | None = None

    @property
    def of_files(self) -> bool:
        """Whether its sources are files or folders."""
        return self.recognise is not _not_mine
