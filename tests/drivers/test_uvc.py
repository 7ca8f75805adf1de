"""USB cameras with a stand-in for OpenCV's capture: how frames are divided, stamped, lost and found again."""

from __future__ import annotations

import os
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.live.errors import DeviceLost, NotFound
from stereo_sfm.drivers.uvc import DRIVER, UvcOptions
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole

W, H = 64, 48
CAMERA = Pinhole(W, H, 50.0, 50.0, 32.0, 24.0)
RIG = Rig(CAMERA, CAMERA, se3.from_rotation_translation(np.eye(3), np.array([0.1, 0, 0])))


class Capture:
    """A camera that offers some sizes, and stops after `count` frames each time it is opened."""

    sizes = ((2 * W, H), (W, H))
    count, attached, stamped = 5, True, True
    opened = 0

    def __init__(self, camera: int | str, backend: int) -> None:
        self.camera, self.left, self.asked = camera, self.count, {}
        self.size: tuple[float, float] = self.sizes[0]
        Capture.opened += 1
        self.at = 1000.0 * Capture.opened

    def isOpened(self) -> bool:
        return self.attached

    def set(self, name: int, value: float) -> None:
        self.asked[name] = value
        asked = self.asked.get(cv2.CAP_PROP_FRAME_WIDTH), self.asked.get(cv2.CAP_PROP_FRAME_HEIGHT)
        self.size = asked if asked in self.sizes else self.size

    def get(self, name: int) -> float:
        told = {cv2.CAP_PROP_FRAME_WIDTH: self.size[0], cv2.CAP_PROP_FRAME_HEIGHT: self.size[1]}
        return told.get(name, self.at if self.stamped else 0.0)

    def grab(self) -> bool:
        self.left, self.at = self.left - 1, self.at + 33.0
        return self.left >= 0

    def retrieve(self) -> tuple[bool, Any]:
        image = np.zeros((int(self.size[1]), int(self.size[0]), 3), np.uint8)
        image[:H, :W] = 10 + 100 * int(self.camera == 2)
        image[:, W:] = 200
        image[H:] = 200
        return True, image

    def release(self) -> None:
        return


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> type[Capture]:
    class Mine(Capture):
        pass

    monkeypatch.setattr(cv2, "VideoCapture", Mine)
    return Mine


def options(**given: object) -> UvcOptions:
    return UvcOptions(**{"rig": RIG, "reconnect": 0.0, **given})  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("place", "sizes"), [("0", ((2 * W, H),)), ("0", ((W, 2 * H),)), ("0,2", ((W, H),))])
def test_both_images(camera: type[Capture], place: str, sizes: tuple[tuple[int, int], ...]) -> None:
    camera.sizes = sizes
    with DRIVER.open(place, options()) as source:
        images = list(islice(source, 4))
    assert source.live and [image.frame_id for image in images] == [0, 1, 2, 3]
    assert set(np.diff([image.stamp_ns for image in images])) == {33_000_000}
    assert images[0].right is not None and images[0].right.shape == (H, W)
    assert images[0].left.max() == 10 and images[0].right.min() == (110 if "," in place else 200)


def test_a_camera_without_stamps_has_ascending_ones(camera: type[Capture]) -> None:
    camera.stamped = False
    with DRIVER.open("0", options()) as source:
        assert (np.diff([image.stamp_ns for image in islice(source, 4)]) > 0).all()


def test_a_lost_camera_is_opened_again(camera: type[Capture], monkeypatch: pytest.MonkeyPatch) -> None:
    with DRIVER.open("0", options()) as source:
        images = iter(source)
        stamps = [image.stamp_ns for image in islice(images, 7)]  # four, and three of the next time
        assert (np.diff(stamps) > 0).all()
        monkeypatch.setattr(camera, "attached", False)
        with pytest.raises(DeviceLost, match="did not come back"):
            list(images)


def test_what_cannot_be_is_one_line(camera: type[Capture]) -> None:
    with pytest.raises(StereoSfmError, match="name one camera"):
        DRIVER.check("0,1,2", options())
    with pytest.raises(StereoSfmError, match="has no calibration"):
        DRIVER.open("0", options(rig=None))
    camera.sizes = ((640, 480),)
    with pytest.raises(StereoSfmError, match="frames of 640x480 are neither"):
        DRIVER.open("0", options())
    camera.attached = False
    with pytest.raises(NotFound, match="cannot open the USB camera 0"):
        DRIVER.open("0", options())


@pytest.mark.parametrize("make", [Path.touch, os.mkfifo])
def test_a_file_or_a_pipe_is_no_camera(make: Callable[[Path], None], tmp_path: Path) -> None:
    """OpenCV would wait for whoever writes into the pipe."""
    make(tmp_path / "video0")
    with pytest.raises(NotFound, match="video0 is no USB camera"):
        DRIVER.open(str(tmp_path / "video0"), UvcOptions(rig=RIG))
