"""USB cameras with a stand-in for OpenCV's capture: how frames are divided, stamped, lost and found again."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from itertools import islice
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
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

    def getBackendName(self) -> str:
        return "ANOTHER"

    def retrieve(self) -> tuple[bool, Any]:
        image = np.zeros((int(self.size[1]), int(self.size[0]), 3), np.uint8)
        image[:H, :W] = 10 + 100 * int(self.camera == 2)
        image[:, W:] = 200
        image[H:] = 200
        return True, image

    def release(self) -> None:
        return


class Queued(Capture):
    """V4L2: a started camera exposes every 33 ms, but fills no more than three buffers; the oldest comes first."""

    sizes, now_ms = ((W, H),), 0.0
    lost: Mapping[int, set[int]] = MappingProxyType({})  # exposures that never come, of each camera
    clocks: Mapping[int, float] = MappingProxyType({})  # ms that a camera's clock is ahead
    noise_ms = 0.0  # of every other stamp of camera 2

    def __init__(self, camera: int, backend: int) -> None:
        super().__init__(camera, backend)
        self.number, self.next, self.waiting = camera, -1, list[float]()

    def getBackendName(self) -> str:
        return "V4L2"

    def expose(self) -> None:
        while (at := 33.0 * self.next) <= Queued.now_ms:
            if len(self.waiting) < 3 and self.next not in self.lost.get(self.number, ()):
                self.waiting.append(at)
            self.next += 1

    def grab(self) -> bool:
        if self.next < 0:
            self.next = round((Queued.now_ms + 300) / 33)
        self.expose()
        while not self.waiting:
            Queued.now_ms += 1
            self.expose()
        exposed = self.waiting.pop(0)
        noise_ms = self.noise_ms * (round(exposed / 33) % 2) * (self.number == 2)
        self.at = 3.6e6 + exposed + noise_ms + self.clocks.get(self.number, 0.0)  # an hour after the start
        return True


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


def skews(place: str, count: int, **given: object) -> list[float]:
    """Right stamps less left ones, ms, of a tracker that takes 5 ms, and a second to start."""
    with DRIVER.open(place, options(**given)) as source:
        Queued.now_ms += 1000
        found: list[float] = []
        for image in islice(source, count):
            found.append((image.right_stamp_ns - image.stamp_ns) / 1e6 if image.right_stamp_ns else np.nan)
            Queued.now_ms += 5
    return found


@pytest.mark.parametrize("lost", [{}, {0: {100, 130}}, {2: {100, 101, 102}}, {0: {60}, 2: {90}}])
@pytest.mark.parametrize("swap", [False, True])
def test_two_cameras_are_paired_by_time(lost: dict[int, set[int]], swap: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though both were started one after the other, old frames wait, and some are lost."""
    monkeypatch.setattr(cv2, "VideoCapture", Queued)
    monkeypatch.setattr(Queued, "now_ms", 0.0)
    monkeypatch.setattr(Queued, "lost", lost)
    assert skews("0,2", 120, swap=swap) == [0.0] * 120


def test_cameras_half_a_frame_apart_do_not_overtake_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", Queued)
    monkeypatch.setattr(Queued, "now_ms", 0.0)
    monkeypatch.setattr(Queued, "clocks", {2: 15.0})
    monkeypatch.setattr(Queued, "noise_ms", 3.0)
    monkeypatch.setattr(Queued, "lost", {0: {80}})
    found = skews("0,2", 100)
    assert set(found) == {15.0, 18.0, -18.0, -15.0}
    assert np.count_nonzero(np.diff(np.sign(found))) == 1  # by the lost frame


@pytest.mark.parametrize("clocks", [{2: 1e6}, {0: -1e9}])
def test_clocks_that_differ_are_said_once(
    clocks: dict[int, float], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Or one of them tells no time: then there is nothing to say."""
    monkeypatch.setattr(cv2, "VideoCapture", Queued)
    monkeypatch.setattr(Queued, "now_ms", 0.0)
    monkeypatch.setattr(Queued, "clocks", clocks)
    assert np.isnan(skews("0,2", 30)).all()
    assert caplog.text.count("different clocks") == int(2 in clocks)


def test_another_backend_tells_no_common_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", Queued)
    monkeypatch.setattr(Queued, "getBackendName", lambda _: "FFMPEG")
    assert np.isnan(skews("0,2", 10)).all()


@pytest.mark.parametrize("count", [0, 1])
def test_a_camera_without_images_is_not_waited_for_longer(
    count: int, camera: type[Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It opens, and gives nothing or one image: the time for it to come back goes on, with a pause between tries."""
    now, asked, pauses = [0.0], list[int](), list[float]()

    def monotonic() -> float:
        asked.append(1)
        assert len(asked) < 100
        return now[0]

    def sleep(seconds: float) -> None:
        pauses.append(seconds)
        now[0] += seconds

    with DRIVER.open("0", options(reconnect=1.0)) as source:
        images = iter(source)
        assert len(list(islice(images, 4))) == 4
        clock = SimpleNamespace(monotonic=monotonic, sleep=sleep)
        monkeypatch.setattr("stereo_sfm.drivers.uvc.source.time", clock)
        monkeypatch.setattr(camera, "count", count)
        with pytest.raises(DeviceLost, match="did not come back within 1 s"):
            next(images)
    assert 5 <= len(pauses) <= 6 and min(pauses) > 0


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
