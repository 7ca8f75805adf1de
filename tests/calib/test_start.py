"""A start that fails: each usual mistake, put into good images, is named; good images are left alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import stereo_sfm as s
from stereo_sfm.calib.start import check_start
from stereo_sfm.geometry import se3

Change = Callable[[s.StereoImage], s.StereoImage]


@pytest.fixture(scope="module")
def images() -> tuple[s.Rig, list[s.StereoImage]]:
    with s.open_source(s.demo_recording()) as source:
        return source.rig, [image for number, image in zip(range(11), source, strict=False) if number % 5 == 0]


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
    why = check_start(rig, [change(image) for image in good])
    assert message in why and "\n" not in why


def test_an_inverted_transform_is_reported(images: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, good = images
    inverted = replace(rig, left_T_right=se3.inverse(rig.left_T_right))
    assert check_start(inverted, good).startswith("left_T_right is inverted: 0 stereo matches")


def test_the_calibration_of_other_cameras_is_suspected(images: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, good = images
    bent = rig.left_T_right @ se3.exp(np.array([0, 0, 0, 0.3, 0.2, 0.1]))
    assert "is this the calibration of these cameras?" in check_start(replace(rig, left_T_right=bent), good)


def test_good_images_give_no_diagnosis(images: tuple[s.Rig, list[s.StereoImage]]) -> None:
    assert check_start(*images) == ""
