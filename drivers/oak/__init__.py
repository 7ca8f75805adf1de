"""OAK cameras over depthai 3 as a kind of source. Nothing of depthai is imported before a camera is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from stereo_sfm.drivers.driver import Attached, Cameras, Driver, UsbId
from stereo_sfm.drivers.options import SourceOptions, option, read_size

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


@dataclass(frozen=True)
class OakOptions(SourceOptions):
    """Options of `oak`, `oak:ID` and `oak:ADDRESS`."""

    size: tuple[int, int] = option((640, 400), "WIDTHxHEIGHT of the images", read=read_size)
    fps: float = option(30.0, "images per second", low=1, high=120)
    exposure: int | None = option(None, "microseconds; auto: by the camera", low=20, high=33_000)
    iso: int = option(400, "with manual exposure", low=100, high=1600)
    anti_flicker: Literal["50", "60", "auto", "off"] = option("50", "Hz of the mains, with automatic exposure")
    max_exposure: int | None = option(None, "microseconds, with automatic exposure", low=20, high=33_000)
    imu: bool = option(True, "pass on inertial samples with the images")
    allow_slow: bool = option(False, "accept a USB 2 link, with lost images")
    queue: int = option(30, "pairs that may wait for the tracker", low=1, high=100_000)
    reconnect: float = option(20.0, "seconds to wait for a lost camera", low=0, high=86_400)


def _open(place: str, options: OakOptions) -> Source:
    from stereo_sfm.drivers.oak.source import open_oak

    return open_oak(place, options)


def _find(probe: bool) -> Sequence[Attached]:
    from stereo_sfm.drivers.oak.attached import find_all

    return find_all(probe)


DRIVER = Driver("Luxonis OAK, over depthai 3", "ID", OakOptions, _open, cameras=Cameras("OAK", _find, (UsbId(0x03E7),)))
