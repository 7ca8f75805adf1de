"""Videos of two cameras: where the images lie in a frame, their times, and what is refused."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.driver import Certainty
from stereo_sfm.drivers.source import Source
from stereo_sfm.drivers.video import DRIVER, VideoOptions
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.types import U8

W, H, FPS = 64, 48, 20.0
CAMERA = Pinhole(W, H, 50.0, 50.0, 32.0, 24.0)
RIG = Rig(CAMERA, CAMERA, se3.from_rotation_translation(np.eye(3), np.array([0.1, 0, 0])))


def view(k: int, side: int) -> U8:
    return np.random.default_rng(2 * k + side).integers(0, 256, (H, W), np.uint8)


def write(path: Path, frames: list[U8]) -> Path:
    """Lossless."""
    height, width = frames[0].shape
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), FPS, (width, height), True)
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def opened(path: Path, **options: object) -> Source:
    return DRIVER.open(str(path), VideoOptions(**{"rig": RIG, **options}))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("layout", ["side by side", "above", "swapped", "two files"])
def test_both_images_of_each_frame(layout: str, tmp_path: Path) -> None:
    pairs = [(view(k, 0), view(k, 1)) for k in range(5)]
    options: dict[str, object] = {"swap": layout == "swapped"}
    if layout == "two files":
        options["right"] = str(write(tmp_path / "right.mkv", [right for _, right in pairs]))
        path = write(tmp_path / "left.mkv", [left for left, _ in pairs])
    else:
        axis = 0 if layout == "above" else 1
        frames = [np.concatenate(pair[::-1] if layout == "swapped" else pair, axis) for pair in pairs]
        path = write(tmp_path / "a.mkv", frames)
    with opened(path, **options) as source:
        for _ in range(2):  # twice the same
            images = list(source)
            assert [image.stamp_ns for image in images] == [k * 50_000_000 for k in range(5)]
            for image, (left, right) in zip(images, pairs, strict=True):
                assert image.right is not None
                assert np.abs(image.left.astype(int) - left).max() <= 2  # through YUV
                assert np.abs(image.right.astype(int) - right).max() <= 2


def test_a_given_rate(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mkv", [np.concatenate([view(k, 0), view(k, 1)], 1) for k in range(3)])
    with opened(path, fps=4.0) as source:
        assert [image.stamp_ns for image in source] == [0, 250_000_000, 500_000_000]


def test_files_of_two_lengths_are_doubted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    right = write(tmp_path / "right.mkv", [view(k, 1) for k in range(3)])
    left = write(tmp_path / "left.mkv", [view(k, 0) for k in range(5)])
    with caplog.at_level(logging.WARNING, "stereo_sfm"), opened(left, right=str(right)) as source:
        assert source.frame_count == len(list(source)) == 3
    assert "have 5 and 3 frames, which are paired from the first on" in caplog.text


def test_what_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StereoSfmError, match="neither two images of the calibration's 64x48"):
        opened(write(tmp_path / "a.mkv", [view(0, 0)]))
    with pytest.raises(StereoSfmError, match="no calibration"):
        opened(tmp_path / "a.mkv", rig=None)
    (tmp_path / "b.mp4").write_bytes(b"nothing")
    with pytest.raises(StereoSfmError, match="not a video"):
        opened(tmp_path / "b.mp4")
    assert DRIVER.recognise(tmp_path / "a.mkv") == Certainty.MARKED and not DRIVER.recognise(tmp_path)
