"""Two webcams as one stereo camera: `webcam:0,2?rig=rig.yaml&fps=30`, or two video files: `webcam:left.mp4,right.mp4`.

The right camera is grabbed right after the left one: good enough for a robot that drives slowly, not for fast turns.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import cv2

from stereo_sfm.calib import load_rig
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.driver import Cameras, Driver
from stereo_sfm.drivers.options import SourceOptions, option
from stereo_sfm.drivers.source import BaseSource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import StereoImage


@dataclass(frozen=True)
class WebcamOptions(SourceOptions):
    """Options of `webcam:LEFT,RIGHT`."""

    fps: float = option(30.0, "images a second: asked of the cameras, taken for the stamps of files", low=1, high=240)


class WebcamSource(BaseSource):
    """Both cameras, opened at once; files are stamped by their frame rate, cameras by this computer's clock."""

    def __init__(self, place: str, options: WebcamOptions) -> None:
        if options.rig is None:
            raise StereoSfmError("webcam: two webcams have no calibration of their own: give --rig FILE")
        self.name = f"webcam:{place}"
        self.rig = options.rig if isinstance(options.rig, Rig) else load_rig(options.rig)
        cameras = place.split(",")
        self.live = all(camera.isdigit() for camera in cameras)
        self._period_ns = 1e9 / options.fps
        self._captures = [cv2.VideoCapture(int(camera) if self.live else camera) for camera in cameras]
        for camera, capture in zip(cameras, self._captures, strict=True):
            capture.set(cv2.CAP_PROP_FPS, options.fps)
            if not capture.isOpened():
                self.close()
                raise StereoSfmError(f"webcam: cannot open {camera}")

    def __iter__(self) -> Iterator[StereoImage]:
        frame_id = 0
        while all(capture.grab() for capture in self._captures):
            stamp_ns = time.monotonic_ns() if self.live else round(frame_id * self._period_ns)
            left, right = (cv2.cvtColor(c.retrieve()[1], cv2.COLOR_BGR2GRAY) for c in self._captures)
            yield StereoImage(frame_id, stamp_ns, left, right)
            frame_id += 1

    def close(self) -> None:
        for capture in self._captures:
            capture.release()


def check(place: str, options: WebcamOptions) -> None:
    """Two cameras must be named; said before anything is opened."""
    if len(place.split(",")) != 2:
        raise StereoSfmError(f"webcam: name the left and the right camera, such as webcam:0,2, not '{place}'")


DRIVER = Driver(
    "a pair of webcams, or of video files", "LEFT,RIGHT", WebcamOptions, WebcamSource, check, cameras=Cameras("webcam")
)
