"""The Intel RealSense T265 as a kind of source; `stereo_sfm.drivers.t265.source` talks to it over raw USB."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal

from stereo_sfm.drivers.driver import Attached, Cameras, Driver, UsbId
from stereo_sfm.drivers.options import SourceOptions, option
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.errors import StereoSfmError, require

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source

SIMULATED = "simulated"


def _from_python(value: Any) -> Any:
    if isinstance(value, str):
        raise ValueError("a Python object (not available on the command line)")
    return value


_OF_THE_SIMULATED = ("images", "frames", "faults", "paced", "seed")


@dataclass(frozen=True)
class T265Options(SourceOptions):
    """Options of `t265`, `t265:SERIAL` and `t265:simulated`."""

    GROUPS = {f"only of t265:{SIMULATED}": _OF_THE_SIMULATED}  # noqa: RUF012

    exposure: int | None = option(
        None, "microseconds; auto: by the camera", low=m.MIN_EXPOSURE_US, high=m.MAX_EXPOSURE_US
    )
    gain: float = option(2.0, "with manual exposure", low=m.MIN_GAIN, high=m.MAX_GAIN)
    anti_flicker: Literal["50", "60", "off"] = option("50", "Hz of the mains, with automatic exposure")
    imu: bool = option(True, "pass on inertial samples with the images")
    firmware: str | None = option(
        None, "path of the firmware file; auto: the file written by 't265 firmware extract'", file=True
    )
    allow_slow: bool = option(False, "accept a USB 2 link, with lost images")
    stamp: Literal["middle", "start"] = option("middle", "the moment of the exposure of the camera's stamps")
    queue: int = option(30, "pairs that may wait for the tracker", low=1, high=100_000)
    reconnect: float = option(20.0, "seconds to wait for a lost camera", low=0, high=86_400)
    backend: Any = option(None, "a pyusb backend, from Python only", read=_from_python)
    images: str = option("room", "scene of a simulated camera: room, or a source such as sim:loop")
    frames: int = option(60, "images rendered before the start, then played forwards and backwards", low=1, high=3000)
    faults: str = option("none", "names of stereo_sfm.drivers.t265.simulated.faults.PRESETS, separated by commas")
    paced: bool = option(True, "real time; off: as fast as the host reads")
    seed: int = option(0, "of the simulated room", low=0, high=2**31)


def _open(place: str, options: T265Options) -> Source:
    require(("usb",), "t265", "the T265, also the simulated one,")
    if place == SIMULATED:
        from stereo_sfm.drivers.t265.simulated.source import open_simulated

        return open_simulated(options)
    from stereo_sfm.drivers.t265.source import open_t265

    return open_t265(place, options)


def _check(place: str, options: T265Options) -> None:
    if place == SIMULATED:
        return
    for f in fields(options):
        if f.name in _OF_THE_SIMULATED and getattr(options, f.name) != f.default:
            raise StereoSfmError(f"t265: option {f.name} is only valid for t265:{SIMULATED}")


def _find(probe: bool) -> Sequence[Attached]:
    from stereo_sfm.drivers.t265.attached import find

    return find()


DRIVER = Driver(
    "Intel RealSense T265, over raw USB",
    "SERIAL",
    T265Options,
    _open,
    _check,
    cameras=Cameras("T265", _find, tuple(UsbId(*id) for id in (*m.RUN_IDS, m.BOOT_ID)), f"t265:{SIMULATED}"),
)
