"""USB cameras (UVC) as a kind of source: one that delivers both images in each frame, or two."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Cameras, Driver
from stereo_sfm.drivers.options import option
from stereo_sfm.drivers.video import VideoOptions
from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source


@dataclass(frozen=True)
class UvcOptions(VideoOptions):
    """Options of `uvc:CAMERA`. The calibration says the size of an image, and with that how frames are divided."""

    right: str = option("", "the right camera, where each is one of its own, as in uvc:0,2")
    fps: float | None = option(None, "images a second that are asked for; auto: as the camera likes", low=1, high=240)
    reconnect: float = option(20.0, "seconds to wait for a lost camera", low=0, high=86_400)


def _open(place: str, options: UvcOptions) -> Source:
    from stereo_sfm.drivers.uvc.source import UvcSource

    return UvcSource(place or "0", options)


def _check(place: str, options: UvcOptions) -> None:
    if len(place.split(",")) > 2 or ("," in place and options.right):
        raise StereoSfmError("uvc: name one camera with both images, such as uvc:0, or two, such as uvc:0,2")


DRIVER = Driver(
    "USB cameras: both images side by side or one above the other, or two cameras, with a rig file", "CAMERA[,CAMERA]",
    UvcOptions, _open, _check, cameras=Cameras("USB camera"),
)  # fmt: skip
