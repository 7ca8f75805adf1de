"""RealSense D400 and D500 cameras over pyrealsense2, and files of its recorder, as a kind of source.

Nothing of pyrealsense2 is imported before a camera or a file is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from stereo_sfm.drivers.driver import Attached, Cameras, Driver, UsbId
from stereo_sfm.drivers.options import SourceOptions, option, read_size

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


@dataclass(frozen=True)
class RealSenseOptions(SourceOptions):
    """Options of `realsense`, `realsense:SERIAL` and `realsense:FILE.bag`, which has its own size, rate and emitter."""

    size: tuple[int, int] = option((848, 480), "WIDTHxHEIGHT of the infrared images", read=read_size)
    fps: int = option(30, "images per second", low=1, high=300)
    emitter: Literal["off", "alternate"] = option("off", "of the dots; alternate: in every other image, not passed on")
    exposure: int | None = option(None, "microseconds; auto: by the camera", low=1, high=200_000)
    imu: bool = option(True, "pass on inertial samples with the images")
    queue: int = option(30, "pairs that may wait for the tracker", low=1, high=100_000)
    reconnect: float = option(20.0, "seconds to wait for a lost camera", low=0, high=86_400)


def _open(place: str, options: RealSenseOptions) -> Source:
    if Path(place).expanduser().suffix == ".bag":
        from stereo_sfm.drivers.realsense.recording import open_recording

        return open_recording(Path(place).expanduser(), options)
    from stereo_sfm.drivers.realsense.source import open_realsense

    return open_realsense(place, options)


def _find(probe: bool) -> Sequence[Attached]:
    from stereo_sfm.drivers.realsense.library import find_all

    return find_all()


# Intel's stereo cameras; a T265, which has another vendor or product, is not among them.
_PRODUCTS = (0x0AD3, 0x0B07, 0x0B3A, 0x0B5C, 0x0B5B, 0x0AD1, 0x0AD2, 0x0AD4, 0x0AD5, 0x0B56)
DRIVER = Driver(
    "RealSense D400 and D500, over pyrealsense2, and files of its recorder", "SERIAL|FILE", RealSenseOptions, _open,
    cameras=Cameras("RealSense", _find, tuple(UsbId(0x8086, product) for product in _PRODUCTS)),
)  # fmt: skip
