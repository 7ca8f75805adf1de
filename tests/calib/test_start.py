"""A start that fails: each usual mistake, put into good images, is named; good images are left alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import stereo_sfm as s
from stereo_sfm.calib.rectification import rectify
from stereo_sfm.calib.start import check_start
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole, RadTan
from stereo_sfm.types import U8

Change = Callable[[s.StereoImage], s.StereoImage]


def slow(*values: object) -> Any:
    """A case that takes seconds and has a sibling among the fast tests."""
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def images() -> tuple[s.Rig, list[s.StereoImage]]:
    with s.open_source(s.demo_recording()) as source:
        return source.rig, list(islice(source, 13))


def right_of(image: s.StereoImage) -> U8:
    assert image.right is not None
    return image.right


def turned(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[::-1, ::-1])


CHANGES: dict[str, tuple[Change, str]] = {
    "swapped": (lambda i: replace(i, left=i.right, right=i.left), "left and right are swapped"),
    "upside down": (lambda i: replace(i, left=turned(i.left), right=turned(i.right)), "both images are upside down"),
    "left down": (lambda i: replace(i, left=turned(i.left)), "the left image is upside down: 0 stereo"),
    "right down": (lambda i: replace(i, right=turned(i.right)), "the right image is upside down: 0 stereo"),
    "dark": (lambda i: replace(i, left=i.left // 40, right=i.right // 40), "nearly black"),
    "light": (lambda i: replace(i, left=np.maximum(i.left, 250), right=i.right), "nearly white"),
    "covered": (lambda i: replace(i, left=i.left // 100 + 90, right=i.right), "no contrast"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_mistake_in_the_images_is_reported(images: tuple[s.Rig, list[s.StereoImage]], name: str) -> None:
    rig, good = images
    change, message = CHANGES[name]
    why = check_start(rig, [change(image) for image in good]).text
    assert message in why and "\n" not in why


def test_far_scenes_upside_down_are_not_corrected_by_a_turn() -> None:
    """Disparities of a few pixels: a turn of 4.4 degrees would bring the rows of other matches together."""
    with s.open_source("sim:aisle?size=320x240&frames=13") as source:
        rig, images = source.rig, [replace(i, left=turned(i.left), right=turned(right_of(i))) for i in source]
    found = check_start(rig, images)
    assert "both images are upside down" in found.text and found.shown and found.rig is None


def test_a_turn_that_leaves_points_behind_the_cameras_is_corrected(data_root: Path) -> None:
    """The right camera is turned about y, too, which no rows show: every eighth point seems to lie behind."""
    with s.open_source(data_root / "kitti") as source:
        rig, images = source.rig, list(islice(source, 13))
    bent = replace(rig, left_T_right=rig.left_T_right @ se3.exp(np.deg2rad([0, 0, 0, 1.0, 0.6, 0])))
    found = check_start(bent, images)
    assert "turned by -1.0" in found.text and found.rig is not None


def test_an_inverted_transform_is_reported(images: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, good = images
    inverted = replace(rig, left_T_right=se3.inverse(rig.left_T_right))
    found = check_start(inverted, good)
    assert found.text.startswith("left_T_right is inverted: 0 stereo matches") and found.shown


def test_a_transform_in_the_axes_of_a_robot_is_reported(pair: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, good = pair
    optical_T_body = np.eye(4)
    optical_T_body[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    found = check_start(replace(rig, left_T_right=optical_T_body.T @ rig.left_T_right @ optical_T_body), good)
    assert "body's axes (x forwards)" in found.text and found.shown and found.rig is None


def test_the_calibration_of_other_cameras_is_suspected(images: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, good = images
    bent = rig.left_T_right @ se3.exp(np.array([0, 0, 0, 0.3, 0.2, 0.1]))
    found = check_start(replace(rig, left_T_right=bent), good)
    assert "is this the calibration of these cameras?" in found.text and not found.shown


def test_good_images_give_no_diagnosis(images: tuple[s.Rig, list[s.StereoImage]]) -> None:
    assert check_start(*images).text == ""


def test_one_camera_for_both_sides_is_named_and_not_corrected(images: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, good = images
    for seen in (good, good[:1]):
        found = check_start(rig, [replace(image, right=image.left.copy()) for image in seen])
        assert found.text.startswith("left and right show the images of one camera")
        assert found.shown and found.rig is None and found.shift == 0
    assert check_start(rig, [replace(good[0], right=good[0].left), *good[1:]]).text == ""  # a slip of the first pair


def test_two_cameras_with_the_same_view_are_not_one(data_root: Path) -> None:
    """So far away that no disparity is left, both with noise of half a grey level: less than sensors have."""
    with s.open_source(data_root / "kitti") as source:
        rig, good = source.rig, list(islice(source, 13))
    rng = np.random.default_rng(4)

    def noisy(image: U8) -> U8:
        return np.clip(np.round(image + rng.normal(0, 0.5, image.shape)), 0, 255).astype(np.uint8)

    assert check_start(rig, [replace(i, left=noisy(i.left), right=noisy(i.left)) for i in good]).text == ""


@pytest.mark.parametrize(("level", "message"), [(0, "nearly black"), (90, "no contrast")])
def test_a_clock_in_both_images_of_a_dark_or_blank_scene(
    images: tuple[s.Rig, list[s.StereoImage]], level: int, message: str
) -> None:
    rig, good = images
    blank = np.full_like(good[0].left, level)
    cv2.putText(blank, "12:30", (20, 60), cv2.FONT_HERSHEY_SIMPLEX, 1.0, 255, 2)
    assert message in check_start(rig, [replace(image, left=blank, right=blank.copy()) for image in good]).text


@pytest.fixture(scope="module", params=["kitti", "euroc_mh01", "store_walk"])
def pair(request: pytest.FixtureRequest, data_root: Path) -> tuple[s.Rig, list[s.StereoImage]]:
    """A narrow rectified lens, a distorted one and a fisheye, each moving."""
    with s.open_source(data_root / request.param) as source:
        return source.rig, list(islice(source, 13))


def wrong(rig: s.Rig, x_deg: float = 0.0, z_deg: float = 0.0, rows: float = 0.0) -> s.Rig:
    """The rig with a right camera that is turned, or whose image is read further down."""
    assert rig.right is not None
    turned = rig.left_T_right @ se3.exp(np.deg2rad([0, 0, 0, x_deg, 0, z_deg]))
    return replace(rig, left_T_right=turned, right=replace(rig.right, cy=rig.right.cy + rows))


ERRORS = {"x": {"x_deg": 2.0}, "z": {"z_deg": -2.0}, "both": {"x_deg": -1.0, "z_deg": 1.5}, "rows": {"rows": -6.0}}


@pytest.mark.parametrize("name", ["both", "rows", slow("x"), slow("z")])
def test_a_large_error_is_found_and_corrected(pair: tuple[s.Rig, list[s.StereoImage]], name: str) -> None:
    rig, images = pair
    found = check_start(wrong(rig, **ERRORS[name]), images)
    assert found.rig is not None and found.shown and found.shift == 0 and "check-calib" in found.advice
    away = se3.inverse(rig.left_T_right) @ found.rig.left_T_right
    rows = 0.0 if found.rig.right is None or rig.right is None else found.rig.right.cy - rig.right.cy
    about_x = np.rad2deg(se3.log(away)[3] + rows / rig.left.fy)  # rows and a turn are alike in a narrow lens
    assert abs(about_x) < 0.05 and abs(np.rad2deg(se3.log(away)[5])) < 0.05
    assert check_start(found.rig, images).text == ""


def test_few_corners_with_matches_are_enough(data_root: Path) -> None:
    """A small part of the shelf between smooth walls: 20 corners, 15 of them with a match."""
    with s.open_source(data_root / "store_walk") as source:
        rig, images = source.rig, list(islice(source, 13))
    height, width = images[0].left.shape
    part = np.zeros((height, width), bool)
    part[int(0.4 * height) : int(0.6 * height), int(0.3 * width) : int(0.7 * width)] = True
    wall = np.repeat(np.linspace(40, 200, height).astype(np.uint8)[:, None], width, 1)
    few = [
        replace(image, left=np.where(part, image.left, wall), right=np.where(part, right_of(image), wall))
        for image in images
    ]
    found = check_start(wrong(rig, rows=-6.0), few)
    assert found.rig is not None and found.shown and "6.0 px" in found.text
    assert check_start(rig, few).rig is None


def test_one_real_camera_for_both_sides(pair: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, images = pair
    found = check_start(rig, [replace(image, right=image.left) for image in images])
    assert "the images of one camera" in found.text and found.shown and found.rig is None


def test_small_errors_and_right_calibrations_stay(pair: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, images = pair
    read = iter(images)
    assert check_start(rig, read).text == "" and len(list(read)) == len(images) - 1  # one pair is enough
    assert check_start(wrong(rig, z_deg=0.05), images).rig is None


@pytest.mark.parametrize(("name", "shift"), [slow("kitti", -2), ("kitti", 1), ("store_walk", 2)])
def test_images_paired_frames_apart_are_found(data_root: Path, name: str, shift: int) -> None:
    with s.open_source(data_root / name) as source:
        rig, images = source.rig, list(islice(source, 17))
    apart = [replace(images[k], right=images[k - shift].right) for k in range(2, 15)]
    found = check_start(rig, apart)
    assert found.shift == shift and found.rig is rig
    assert "stamps" in found.advice and "check-calib" not in found.advice  # which writes no shift
    assert check_start(wrong(rig, x_deg=1.0), apart).shift == shift


def test_noise_corrects_nothing(pair: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, images = pair
    rng = np.random.default_rng(3)
    noise = [rng.integers(0, 255, (2, *images[0].left.shape), np.uint8) for _ in range(13)]
    assert check_start(rig, [replace(images[0], left=a, right=b) for a, b in noise]).rig is None


def misread(camera: Camera, model: type[Camera]) -> Camera:
    """The numbers of a lens under the name of another model; a pinhole has no coefficients."""
    distortion = () if model is Pinhole else camera.distortion
    return model(*camera.size, camera.fx, camera.fy, camera.cx, camera.cy, distortion)


@pytest.mark.parametrize("cameras", ["both", slow("left")])
@pytest.mark.parametrize(("name", "wrong_model"), [("store_walk", RadTan), ("euroc_mh01", KannalaBrandt)])
def test_a_lens_under_the_name_of_another_model(
    data_root: Path, name: str, wrong_model: type[Camera], cameras: str
) -> None:
    with s.open_source(data_root / name) as source:
        rig, images = source.rig, list(islice(source, 13))
    assert rig.right is not None
    right = misread(rig.right, wrong_model) if cameras == "both" else rig.right
    found = check_start(replace(rig, left=misread(rig.left, wrong_model), right=right), images)
    assert found.shown and f"contradict the lens model {wrong_model.model}" in found.text
    assert found.rig is not None and found.rig.right is not None
    assert (found.rig.left.model, found.rig.right.model) == (rig.left.model, rig.right.model)
    assert "stereo-sfm calibrate" in found.advice and "check-calib" not in found.advice  # which writes no lens model
    assert check_start(found.rig, images).text == ""


@pytest.mark.parametrize(
    ("name", "rectified"),
    [("store_walk", False), ("euroc_mh01", True), slow("store_walk", True), slow("euroc_mh01", False)],
)
def test_images_that_are_rectified_or_not_against_their_name(data_root: Path, name: str, rectified: bool) -> None:
    with s.open_source(data_root / name) as source:
        rig, images = source.rig, list(islice(source, 13))
    rectification = rectify(rig, "pinhole", size=rig.left.size)
    if rectified:
        seen = [replace(i, left=a, right=b) for i in images for a, b in [rectification.apply(i.left, right_of(i))]]
        given, meant = rig, rectification.rig
    else:
        seen, given, meant = images, rectification.rig, rig
    found = check_start(given, seen, lambda: ("the images are otherwise", meant))
    assert found.rig is meant and found.shown and "topics" in found.advice
    assert check_start(meant, seen, lambda: ("the images are otherwise", given)).text == ""


@pytest.mark.parametrize("name", ["store_walk", "euroc_mh01"])
def test_a_lens_without_its_distortion_is_no_pass(data_root: Path, name: str) -> None:
    with s.open_source(data_root / name) as source:
        rig, images = source.rig, list(islice(source, 13))
    assert rig.right is not None
    found = check_start(replace(rig, left=misread(rig.left, Pinhole), right=misread(rig.right, Pinhole)), images)
    assert found.shown and found.rig is None  # no coefficients are known that a run could use
    assert "rows are off by" in found.text and "stereo-sfm calibrate" in found.text


def test_coefficients_in_another_programs_order(data_root: Path) -> None:
    with s.open_source(data_root / "euroc_mh01") as source:
        rig, images = source.rig, list(islice(source, 13))
    assert rig.right is not None
    left, right = (
        RadTan(*c.size, c.fx, c.fy, c.cx, c.cy, (*c.distortion[:2], 0.1, *c.distortion[2:4]))
        for c in (rig.left, rig.right)
    )
    found = check_start(replace(rig, left=left, right=right), images)
    assert found.shown and "radtan with k3 before p1 and p2" in found.text
