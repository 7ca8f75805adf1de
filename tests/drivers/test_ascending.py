"""Stamps of any source ascend: doubled and late images are skipped, a clock that is set back goes on."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from stereo_sfm.drivers.ascending import AscendingSource, AscendingStamps, ascending
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.types import ImuSamples, StereoImage, Trajectory
from tests.synthetic import pinhole_rig

PERIOD = 100


def image(number: int, stamp_ns: int) -> StereoImage:
    stamps = np.array([stamp_ns - 1, stamp_ns], np.int64)
    return StereoImage(
        number, stamp_ns, np.zeros((2, 2), np.uint8), imu=ImuSamples(stamps, np.zeros((2, 3)), np.zeros((2, 3)))
    )


def through(stamps: list[int]) -> list[StereoImage]:
    return list(ascending([image(k, t) for k, t in enumerate(stamps)], "a camera"))


def test_ascending_stamps_pass_as_they_are(caplog: pytest.LogCaptureFixture) -> None:
    given = [image(k, t) for k, t in enumerate([5, 6, 900])]
    assert all(a is b for a, b in zip(ascending(given, "a camera"), given, strict=True)) and not caplog.text


@pytest.mark.parametrize(
    ("stamps", "kept"), [([100, 200, 200, 300], [0, 1, 3]), ([100, 200, 300, 200, 400], [0, 1, 2, 4])]
)
def test_doubled_and_late_images_are_skipped_and_counted(
    stamps: list[int], kept: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "stereo_sfm"):
        found = through(stamps)
    assert [x.frame_id for x in found] == kept and found[-1].dropped_before == 1
    assert [x.stamp_ns for x in found] == [stamps[k] for k in kept]
    assert found[-1].imu is not None and len(found[-1].imu) == 4  # with the samples of the one skipped
    assert "1 images were skipped" in caplog.text


@pytest.mark.parametrize("back", [350, 100_000])
def test_a_clock_that_is_set_back_goes_on(back: int, caplog: pytest.LogCaptureFixture) -> None:
    true = [1_000_000 + PERIOD * k for k in range(12)]
    with caplog.at_level(logging.WARNING, "stereo_sfm"):
        found = through(true[:6] + [t - back for t in true[6:]])
    assert [x.stamp_ns for x in found] == true and [x.frame_id for x in found] == list(range(12))
    assert all(x.imu is not None and x.imu.stamp_ns[-1] == x.stamp_ns for x in found)
    assert "set back before image 6" in caplog.text and "skipped" not in caplog.text


def test_a_clock_that_stands_still_gives_one_image() -> None:
    assert len(through([7] * 20)) == 1


def test_stamps_ascend_whatever_comes() -> None:
    random = np.random.default_rng(0)
    for _ in range(50):
        clock = AscendingStamps()
        stamps = [t for given in random.integers(0, 40, 60).tolist() for t in clock.step(given)]
        clock.end()
        assert (np.diff(stamps) > 0).all() and len(stamps) + clock.skipped == 60


@pytest.mark.parametrize("back", [350, 100_000])
def test_a_ground_truth_by_image_goes_on_with_the_images(back: int) -> None:
    """A line of poses.txt for each image, whose clock was set back."""
    true = [1_000_000 + PERIOD * k for k in range(12)]
    given = true[:6] + [t - back for t in true[6:]]
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, 0, 3] = np.arange(12)
    source = MemorySource(pinhole_rig(), [image(k, t) for k, t in enumerate(given)])
    source.ground_truth = Trajectory(np.array(given, np.int64), poses)
    truth = AscendingSource(source).ground_truth
    assert truth is not None and truth.stamp_ns.tolist() == true
    assert truth.positions[:, 0].tolist() == list(range(12))
