"""The Python API: one's own loop gives the bits of a run, and unsuitable images give a one-line error."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stereo_sfm as s
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps.saved_map import save_map
from stereo_sfm.maps.store import lock
from stereo_sfm.pipeline.image_input import ImageInput
from tests.synthetic import pinhole_rig

IMAGES = 12


@pytest.fixture(scope="module")
def recording() -> tuple[s.Rig, list[s.StereoImage]]:
    with s.open_source(s.demo_recording()) as source:
        return source.rig, [image for _, image in zip(range(IMAGES), source, strict=False)]


def test_a_loop_of_ones_own_gives_the_bits_of_a_run(recording: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, images = recording
    run = list(s.run(MemorySource(rig, images)))
    updates: list[s.MapUpdate] = []
    with s.System(rig) as system:
        system.on(s.MapUpdate, updates.append)
        own = [system.step(image.left, image.right, image.stamp_ns) for image in images]
        at = system.map_T_cam
    assert at is not None
    for a, b in zip(run, own, strict=True):
        assert a.odom_T_cam.tobytes() == b.odom_T_cam.tobytes() and a.state == b.state
        assert np.linalg.eigvalsh(b.covariance).min() > 0
    assert len(updates) >= 1 and set(updates[0].kf_ids.tolist()) <= set(system.map.kf_ids.tolist())
    assert len(system.map.points) > 100 and len(system.trajectory()) == len(images)
    np.testing.assert_allclose(at[:3, 3], own[-1].odom_T_cam[:3, 3], atol=0.05)
    system.finish()  # once more does nothing
    with pytest.raises(s.StereoSfmError, match="finished"):
        system.step(images[0].left, images[0].right, 10**18)


def test_samples_of_imu_and_wheels_are_handed_over_with_the_images(caplog: pytest.LogCaptureFixture) -> None:
    spec = "sim:loop?size=212x200&rate=10&frames=20&start=60&imu=t265&wheel=differential"
    with s.open_source(spec) as source:
        images, rig = list(source), source.rig
    run = list(s.run(MemorySource(rig, images)))
    tracker, own = s.Tracker(rig), run[0]
    with s.System(rig) as system:
        for image, frame in zip(images, run, strict=True):
            pixels = image.left, image.right, image.stamp_ns
            own = system.step(*pixels, imu=image.imu, wheel=image.wheel)
            assert own.odom_T_cam.tobytes() == frame.odom_T_cam.tobytes()
            tracker.step(*pixels, imu=image.imu, wheel=image.wheel)
    assert abs(own.stats["pitch_deg"] + 4) < 2 and not caplog.text  # the camera looks 4 degrees down
    black = np.zeros_like(images[-1].left)
    stamp = images[-1].stamp_ns + 10**8
    assert images[-1].imu is not None
    late = images[-1].imu.shifted(10**8)
    assert tracker.step(black, black, stamp, imu=late).state == s.TrackState.INERTIAL
    tracker.step(black, black, stamp + 10**8, imu=late)  # the same ones again
    assert "doubled" in caplog.text


def test_the_callers_arrays_stay_its_own(recording: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, images = recording
    tracker, other = s.Tracker(rig), s.Tracker(rig)
    left, right = np.empty_like(images[0].left), np.empty_like(images[0].left)
    for image in images[:4]:
        assert image.right is not None
        left[:], right[:] = image.left, image.right
        own = tracker.step(left, right, image.stamp_ns)
        left[:], right[:] = 0, 0
        assert own.odom_T_cam.tobytes() == other.step(image.left, image.right, image.stamp_ns).odom_T_cam.tobytes()


def test_images_that_a_source_repeats_are_skipped(recording: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, images = recording
    with s.System(rig) as system:
        frames = list(system.run([*images[:3], images[2], images[3]]))
    assert [frame.frame_id for frame in frames] == [0, 1, 2, 3]


def test_odometry_alone_is_the_same_odometry(recording: tuple[s.Rig, list[s.StereoImage]]) -> None:
    """Until the first map update arrives."""
    rig, images = recording
    tracker = s.Tracker(rig)
    frames = [tracker.step(image.left, image.right, image.stamp_ns) for image in images[:4]]
    run = list(s.run(MemorySource(rig, images[:4])))
    assert all(a.odom_T_cam.tobytes() == b.odom_T_cam.tobytes() for a, b in zip(frames, run, strict=True))


def test_a_map_is_saved_loaded_and_queried(recording: tuple[s.Rig, list[s.StereoImage]], tmp_path: Path) -> None:
    rig, images = recording
    with s.System(rig) as system:
        assert list(system.run(images))[-1] is system.frame
    with lock(tmp_path / "store"), pytest.raises(StereoSfmError, match="stop the service that extends it"):
        system.save_map(tmp_path / "store")
    system.save_map(str(tmp_path / "store"))
    locator = s.MapLocator(s.load_map(str(tmp_path / "store")))
    answer = locator.locate(images[6].left, images[6].right)
    assert answer.found
    known = system.trajectory().poses[6]
    assert np.linalg.norm(answer.map_T_cam[:3, 3] - known[:3, 3]) < 0.02
    assert locator.locate(images[6].left, images[6].right, near=known).found
    saved = system.saved_map()
    scattered = np.random.default_rng(0).integers(0, 256, saved.snapshot.corner_descriptors.shape, np.uint8)
    elsewhere = dataclasses.replace(saved.snapshot, corner_descriptors=scattered)
    save_map(dataclasses.replace(saved, snapshot=elsewhere), tmp_path / "elsewhere")
    for name, recognised in (("elsewhere", False), ("store", True)):
        with s.System(rig, map_in=tmp_path / name, localize_only=True) as again:
            frames = [again.step(image.left, image.right, image.stamp_ns) for image in images]
            assert frames[-1].state == s.TrackState.OK and (again.map_T_cam is not None) == recognised
    black = np.zeros_like(images[6].left)
    assert locator.locate(black, black).reason == "too_few_points"
    with pytest.raises(s.StereoSfmError, match="unknown map format 'kolmap', did you mean colmap"):
        s.export_map(system.saved_map(), tmp_path / "x", "kolmap")
    s.export_trajectory(system.trajectory(), str(tmp_path / "path.tum"))
    assert len(s.read_trajectory(tmp_path / "path.tum")) == IMAGES


# -- input images ------------------------------------------------------------------------------------------------------

RIG = pinhole_rig()
SIZE = (RIG.left.height, RIG.left.width)
GREY = np.random.default_rng(1).integers(0, 256, SIZE, np.uint8)
CONVERTED: dict[str, tuple[Callable[[], Any], int]] = {
    "as it is": (lambda: GREY, 0),
    "not contiguous": (lambda: np.asfortranarray(GREY), 0),
    "a view": (lambda: np.repeat(GREY, 2, 1)[:, ::2], 0),
    "lists": (lambda: GREY.astype(float).tolist(), 0),
    "colour": (lambda: np.repeat(GREY[..., None], 3, 2), 0),
    "colour with alpha": (lambda: np.dstack([GREY, GREY, GREY, GREY]), 0),
    "one channel": (lambda: GREY[..., None], 0),
    "floats to 255": (lambda: GREY.astype(np.float32), 0),
    "floats to 1": (lambda: GREY / 255.0, 0),
    "twelve bits": (lambda: GREY.astype(np.uint16) << 4, 0),
    "sixteen bits": (lambda: GREY.astype(np.uint16) << 8, 0),
}


@pytest.mark.parametrize("name", CONVERTED)
def test_what_can_be_meant_is_converted(name: str) -> None:
    make, off = CONVERTED[name]
    if name == "twelve bits":  # ten would show the same bits: the last of twelve says which
        image = ImageInput(RIG).image(make() | 1, make() | 1, 1)
    else:
        image = ImageInput(RIG).image(make(), make(), 1)
    assert image.right is not None
    for pixels in (image.left, image.right):
        assert pixels.dtype == np.uint8 and pixels.flags.c_contiguous
        assert np.abs(pixels.astype(int) - GREY).max() <= off


def test_colour_is_weighed_as_opencv_does() -> None:
    blue = np.zeros((*SIZE, 3), np.uint8)
    blue[..., 0] = 200
    assert ImageInput(RIG).image(blue, blue, 1).left[0, 0] == 23  # 0.114 of it


def test_more_bits_later_are_taken_from_then_on(caplog: pytest.LogCaptureFixture) -> None:
    images = ImageInput(RIG)
    dark = np.full(SIZE, 101, np.uint16)
    assert images.image(dark, dark, 1).left[0, 0] == 101
    light = np.full(SIZE, 4001, np.uint16)
    assert images.image(light, light, 2).left[0, 0] == 250 and images.image(dark, dark, 3).left[0, 0] == 6


REFUSED: dict[str, tuple[Any, Any, Any, str]] = {
    "another size": (GREY[:, :-2], GREY, 1, "the left image is 638x480, but the calibration is for 640x480"),
    "another size right": (GREY, GREY[:-1], 1, "the right image is 640x479"),
    "turned": (GREY.T, GREY, 1, "the left image is 480x640"),
    "two channels": (np.dstack([GREY, GREY]), GREY, 1, "expected (H, W) grey or (H, W, 3) colour"),
    "a number": (7, GREY, 1, "(H, W) grey"),
    "text": ("left.png", GREY, 1, "(H, W) grey"),
    "truth values": (GREY > 9, GREY, 1, "has bool pixels: expected uint8, uint16 or floats"),
    "whole numbers": (GREY.astype(np.int64), GREY, 1, "has int64 pixels"),
    "not finite": (np.full(SIZE, np.nan), GREY, 1, "not finite"),
    "negative": (GREY - 1.5, GREY, 1, "has values from -1.5"),
    "no right image": (GREY, None, 1, "frame 0 has no right image"),
    "seconds": (GREY, GREY, 0.033, "stamp_ns takes whole nanoseconds, got 0.033"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_image_that_does_not_fit_the_rig_is_one_line(name: str) -> None:
    left, right, stamp_ns, message = REFUSED[name]
    for step in (s.Tracker(RIG).step, s.System(RIG).step):
        with pytest.raises(s.StereoSfmError) as error:
            step(left, right, stamp_ns)
        assert message in str(error.value) and "\n" not in str(error.value)


def test_stamps_grow() -> None:
    images = ImageInput(RIG)
    images.image(GREY, GREY, 5)
    with pytest.raises(s.StereoSfmError, match="stamp_ns is 5, not later than the last one"):
        images.image(GREY, GREY, 5)


def test_a_source_of_the_caller_is_checked_too() -> None:
    small = s.StereoImage(0, 0, GREY[:100].copy(), GREY[:100].copy())
    with pytest.raises(s.StereoSfmError, match="640x100, but the calibration is for 640x480"):
        list(s.run(MemorySource(RIG, [small])))
