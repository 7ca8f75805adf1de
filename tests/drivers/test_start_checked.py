"""A source whose first images are compared with its calibration: every image is passed on, and the rig that fits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import stereo_sfm as s
from stereo_sfm.calib.choice import with_terms
from stereo_sfm.drivers.choice import MadeSource, SourceChoice, with_known_start, with_start_check
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.start_checked import RigChanged, StartCheckedSource, corrected_since
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import CalibrationUpdate

SPEC = "sim:aisle?camera=pinhole&size=320x200&rate=10&frames=16&effects=false"


@pytest.fixture(scope="module")
def good() -> tuple[s.Rig, list[s.StereoImage]]:
    with s.open_source(SPEC) as source:
        return source.rig, list(source)


def turned(rig: s.Rig, deg: float = 1.5) -> s.Rig:
    return replace(rig, left_T_right=rig.left_T_right @ se3.exp(np.deg2rad([0, 0, 0, deg, 0, 0])))


def ids(source: StartCheckedSource) -> list[int]:
    return [image.frame_id for image in source]


def test_a_right_calibration_and_its_images_are_passed_on(good: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, images = good
    with StartCheckedSource(MemorySource(rig, images), correct=True) as source:
        assert source.start_check is None and source.rig is rig
        assert [a is b for a, b in zip(source, images, strict=True)] == [True] * len(images)
        assert ids(source) == list(range(len(images)))  # and again


def test_a_wrong_calibration_is_corrected_and_no_image_is_lost(good: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, images = good
    with StartCheckedSource(MemorySource(turned(rig), images), correct=True) as source:
        assert source.start_check is not None and source.start_check.frame_id == 0
        assert np.rad2deg(se3.extent(se3.inverse(rig.left_T_right) @ source.rig.left_T_right)[1]) < 0.05
        assert ids(source) == list(range(len(images)))
        known = source.start_check
        found = source.rig
    with StartCheckedSource(MemorySource(turned(rig), images), correct=True, known=known) as again:
        assert np.array_equal(again.rig.left_T_right, found.left_T_right)
        assert ids(again) == list(range(len(images)))


@pytest.mark.parametrize("applied", [True, False])
def test_a_correction_of_the_run_is_known_at_the_next_start(
    good: tuple[s.Rig, list[s.StereoImage]], applied: bool
) -> None:
    """The service begins again after a stage has died: with what the camera store keeps meanwhile, if it is kept."""
    rig, images = good
    with StartCheckedSource(MemorySource(turned(rig), images), correct=True) as source:
        start, known = source.rig, source.start_check
    assert known is not None
    terms = np.deg2rad([0.1, -0.2, 0.05, 0, 0, 0, 0, 0])
    correction = CalibrationUpdate(7, 3, 0, terms, np.eye(8), 0, applied, "significant", "")
    known = corrected_since(known, start, correction)
    with StartCheckedSource(MemorySource(turned(rig), images), correct=True, known=known) as again:
        expected = with_terms(start, terms) if applied else start
        np.testing.assert_allclose(again.rig.left_T_right, expected.left_T_right, atol=1e-12)


def test_it_is_only_reported_where_nothing_is_to_be_corrected(good: tuple[s.Rig, list[s.StereoImage]]) -> None:
    given = turned(good[0])
    with StartCheckedSource(MemorySource(given, good[1]), correct=False) as source:
        assert source.rig is given
        assert source.start_check is not None and "not corrected" in source.start_check.line


def test_images_paired_a_frame_apart_are_paired_again(good: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, images = good
    for shift in (-1, 1):
        apart = [replace(a, right=b.right) for a, b in zip(images[1:-1], images[1 - shift :], strict=False)]
        with StartCheckedSource(MemorySource(turned(rig), apart), correct=True) as source:
            check = source.start_check
            assert check is not None and check.right_shift == shift
            rights = {image.frame_id: image.right for image in images}
            passed = list(source)
            assert len(passed) == len(apart) - 1
            assert all(image.right is rights[image.frame_id] for image in passed)


class Failing(MemorySource):
    """Ends with an error after three images."""

    def __iter__(self) -> Iterator[s.StereoImage]:
        yield from self.images[:3]
        raise StereoSfmError("a damaged image")


def test_an_error_of_the_source_comes_after_the_images_before_it(good: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, images = good
    with StartCheckedSource(Failing(turned(rig), images), correct=True) as source:
        passed = iter(source)
        assert [next(passed).frame_id for _ in range(3)] == [0, 1, 2]
        with pytest.raises(StereoSfmError, match="a damaged image"):
            next(passed)


class Live(MemorySource):
    """Its images do not wait."""

    live = True
    begun = 0

    def __iter__(self) -> Iterator[s.StereoImage]:
        self.begun += 1
        return super().__iter__()


def test_a_camera_is_looked_at_when_its_images_are_wanted(good: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, images = good
    camera = Live(turned(rig), images)
    with StartCheckedSource(camera, correct=True) as source:
        assert camera.begun == 0 and source.rig is camera.rig
        with pytest.raises(RigChanged) as changed:
            iter(source)
    with StartCheckedSource(camera, correct=True, known=changed.value.check) as again:
        assert again.rig is not camera.rig and ids(again) == list(range(len(images)))
    fits = Live(rig, images)
    with StartCheckedSource(fits, correct=True) as source:
        assert ids(source) == list(range(len(images))) and fits.begun == 1


def test_one_camera_is_not_compared(good: tuple[s.Rig, list[s.StereoImage]]) -> None:
    rig, images = good
    alone = [replace(image, right=None) for image in images]
    with StartCheckedSource(MemorySource(s.Rig(rig.left), alone), correct=True) as source:
        assert source.start_check is None and ids(source) == list(range(len(images)))


def test_runs_check_sources_that_are_named(good: tuple[s.Rig, list[s.StereoImage]]) -> None:
    made = MadeSource.of(MemorySource, good[0], good[1])
    assert with_start_check(made, True) is made
    choice = with_start_check(SourceChoice(SPEC, turned(good[0])), True)
    with choice() as source:
        assert isinstance(source, StartCheckedSource) and source.start_check is not None
        known = with_known_start(choice, source.start_check)
        assert isinstance(known, SourceChoice) and known.start_check is source.start_check
