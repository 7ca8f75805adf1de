"""What sticks to the images while the view moves is found and masked; a camera at rest and good images stay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import stereo_sfm as s
from stereo_sfm.calib.start import StartFinding
from stereo_sfm.calib.sticking import positions, sticking, still_side, with_sticking
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.start_checked import StartCheckedSource
from stereo_sfm.geometry import se3
from stereo_sfm.types import U8


def dots(image: U8, count: int = 300) -> U8:
    out, rng = image.copy(), np.random.default_rng(image.shape[0])
    for u, v in zip(
        rng.integers(9, image.shape[1] - 9, count), rng.integers(9, image.shape[0] - 9, count), strict=True
    ):
        cv2.circle(out, (int(u), int(v)), 1, 255, -1)
    return out


def dirt(image: U8) -> U8:
    out = image.copy()
    cv2.ellipse(out, (image.shape[1] // 3, image.shape[0] // 2), (25, 18), 20, 0, 360, 30, -1)
    cv2.ellipse(out, (image.shape[1] // 3 + 5, image.shape[0] // 2), (10, 12), 20, 0, 360, 70, -1)
    return out


def text(image: U8) -> U8:
    place = image.shape[1] // 3, image.shape[0] // 2
    return np.asarray(cv2.putText(image.copy(), "CAM 1 12:30", place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2), np.uint8)


def robot(image: U8) -> U8:
    """An edge of the robot at the bottom."""
    out, (rows, columns) = image.copy(), image.shape
    part = out[int(0.85 * rows) :, int(0.2 * columns) : int(0.8 * columns)]
    part[:] = np.random.default_rng(5).integers(20, 120, part.shape, np.uint8)
    return out


@pytest.fixture(scope="module", params=["kitti", "store_walk"])
def images(request: pytest.FixtureRequest, data_root: Path) -> list[s.StereoImage]:
    """Of half the size: the search has no scale."""

    def half(image: U8) -> U8:
        return np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)

    with s.open_source(data_root / request.param) as source:
        found = source.at(positions(source.frame_count))
        return [replace(i, left=half(i.left), right=None if i.right is None else half(i.right)) for i in found]


@pytest.mark.parametrize("change", [dots, dirt, text, robot])
def test_what_sticks_to_the_image_is_masked(images: list[s.StereoImage], change: Callable[[U8], U8]) -> None:
    left, right = sticking(replace(image, left=change(image.left)) for image in images)
    assert not right.any()
    changed = (change(images[0].left) != images[0].left).astype(np.uint8)
    edges = cv2.morphologyEx(changed, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) & changed
    assert left[edges > 0].mean() > 0.15 and left.mean() < 15 * changed.mean()


def test_what_is_masked_already_does_not_count(images: list[s.StereoImage]) -> None:
    """Masked as far as the robot reaches, and no further; and all but a part of it."""
    stuck = [replace(image, left=robot(image.left)) for image in images]
    rows, columns = images[0].left.shape
    mask = np.ones((rows, columns), bool)
    mask[int(0.85 * rows) :, int(0.2 * columns) : int(0.8 * columns)] = False
    assert sticking(stuck, (mask, None)) == []
    mask[:, int(0.6 * columns) :] = True
    left, right = sticking(stuck, (mask, None))
    assert left.any() and not left[:, : int(0.6 * columns)].any() and not right.any()


def test_an_image_without_light_hides_nothing(images: list[s.StereoImage]) -> None:
    """While the lamps are off, all that is seen sticks."""
    stuck = [replace(image, left=text(image.left // 30 if k == 4 else image.left)) for k, image in enumerate(images)]
    assert [part.any() for part in sticking(stuck)] == [True, False]


def test_a_run_has_the_mask_and_says_so(data_root: Path) -> None:
    with s.open_source(data_root / "kitti") as source:
        rig, good = source.rig, list(source.at(positions(source.frame_count)))
    for count, line in ((300, "'stereo-sfm mask"), (40_000, "turn the projector off")):
        stuck = [replace(image, left=dots(image.left, count)) for image in good]
        with StartCheckedSource(MemorySource(rig, stuck), correct=True) as checked:
            found, masked, mask = checked.start_check, checked.rig, checked.rig.left_mask
        assert found is not None and found.shown and line in found.line
        assert "% of the left image sticks to the image" in found.line and "right image" not in found.line
        assert (mask is not None and 0.7 < mask.mean() < 0.99) if count == 300 else not found.rig  # exit code 4
        with StartCheckedSource(MemorySource(masked, stuck), correct=True) as checked:
            assert (checked.start_check is None) == (count == 300)  # with that mask nothing is left to say


def test_a_mask_does_not_mend_a_mistake(data_root: Path) -> None:
    """Else the run counts as corrected, and its exit code is 0."""
    with s.open_source(data_root / "kitti") as source:
        rig, good = source.rig, list(source.at(positions(source.frame_count)))
    stuck = [replace(image, left=dots(image.left)) for image in good]
    for shown in (True, False):
        finding = with_sticking(StartFinding("left and right are exchanged", shown=shown), rig, iter(stuck))
        assert finding.shown and (finding.masked is None) == shown


def passed(image: U8, k: int) -> U8:
    """The k-th image of a camera at rest, with noise and somebody who walks past."""
    rng = np.random.default_rng(k)
    out = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
    at = image.shape[1] * k // 10
    out[:, at : at + image.shape[1] // 10] = rng.integers(0, 255, out[:, at : at + image.shape[1] // 10].shape)
    return out


def test_good_images_and_a_camera_at_rest_are_left_alone(images: list[s.StereoImage]) -> None:
    good, read = images, iter(images)
    assert sticking(read) == [] and list(read)  # a few are enough
    rest = [replace(good[0], left=passed(good[0].left, k), right=None) for k in range(8)]
    assert sticking(rest) == []


def test_a_camera_that_stands_still_beside_one_that_moves(images: list[s.StereoImage]) -> None:
    first, read = images[0], iter(images)
    assert still_side(read) == "" and len(list(read)) == len(images) - 2  # two images that differ are enough
    assert still_side(replace(image, left=first.left) for image in images) == "left"
    assert first.right is not None
    assert still_side(replace(image, right=first.right.copy()) for image in images) == "right"


def test_a_run_says_that_a_camera_stands_still_and_corrects_nothing(data_root: Path) -> None:
    with s.open_source(data_root / "kitti") as source:
        rig, good = source.rig, list(source.at(positions(source.frame_count)))
    stuck = [replace(image, right=good[0].right) for image in good]
    turned = replace(rig, left_T_right=rig.left_T_right @ se3.exp(np.array([0, 0, 0, 0.02, 0, 0])))
    for given in (rig, turned):
        with StartCheckedSource(MemorySource(given, stuck), correct=True) as checked:
            found = checked.start_check
        assert found is not None and found.shown and not found.rig  # exit code 4
        assert "the right camera repeats one image while the left one moves" in found.line


def test_a_camera_at_rest_or_in_the_dark_does_not_stand_still(images: list[s.StereoImage]) -> None:
    first = images[0]
    assert still_side([first] * 8) == ""
    assert still_side(replace(first, left=passed(first.left, k)) for k in range(8)) == ""  # as video files keep a side
    assert still_side(replace(image, right=np.zeros_like(image.left)) for image in images) == ""
    assert still_side(replace(image, right=None) for image in images) == ""


def test_positions_are_within_the_recording() -> None:
    assert positions(13)[-1] == 12 and positions(1) == [0] and positions(None) == positions(10**6)
