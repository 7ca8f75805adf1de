"""Wrong calibrations in the simulated store: lenses that differ from theirs, unequal cameras, wrong stamps."""

from __future__ import annotations

import dataclasses
import functools

import cv2
import numpy as np
import pytest

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.drivers.options import read_options
from stereo_sfm.drivers.sim.lens_errors import LensErrors
from stereo_sfm.drivers.sim.options import SimOptions
from stereo_sfm.drivers.sim.render import pixel_grid
from stereo_sfm.drivers.sim.rigs import CAMERAS, make_rig
from stereo_sfm.drivers.sim.scenes import SCENES
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.sim.world import Layout
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import F64, StereoImage

SMALL = Layout(gondolas=2, gondola_length=5.0, products=40)
SIZE = (212, 200)


def store(**options: object) -> SimSource:
    """The loop in a small store."""
    scene = dataclasses.replace(SCENES["loop"], layout=SMALL)
    return SimSource("loop", scene, read_options(SimOptions, "sim", {"size": "212x200", "frames": 60, **options}))


@functools.cache
def plain(camera: str = "pinhole") -> StereoImage:
    return store(camera=camera, effects=False).frame(40)


def rms(field: F64) -> float:
    return float(np.sqrt(np.nanmean(np.square(field).sum(-1))))


@pytest.mark.parametrize("kind", ["residual", "decentered", "tilted"])
@pytest.mark.parametrize("camera", CAMERAS)
def test_each_camera_has_an_error_of_its_own_of_the_size_asked_for(camera: str, kind: str) -> None:
    left, right = LensErrors(**{kind: 0.5}).displacements(make_rig(camera, SIZE), seed=3)
    assert left is not None and right is not None
    assert rms(left) == pytest.approx(0.5, rel=1e-6) and rms(right) == pytest.approx(0.5, rel=1e-6)
    assert rms(left - right) > 0.2
    assert np.nanmax(np.abs(np.diff(left, axis=0))) < 0.1  # smooth


def test_rows_are_off_in_the_right_image_alone_and_not_everywhere_alike() -> None:
    left, right = LensErrors(rows=0.5).displacements(make_rig("pinhole", SIZE), seed=3)
    assert left is None and right is not None
    assert not right[..., 0].any() and rms(right) == pytest.approx(0.5)
    assert np.std(right[..., 1]) > 0.2


@pytest.mark.parametrize("term", range(8))
@pytest.mark.parametrize("camera", CAMERAS)
def test_no_term_of_the_rig_describes_a_residual_distortion(camera: str, term: int) -> None:
    """To first order: the derivative of where points at infinity are seen is orthogonal to the field."""
    rig = make_rig(camera, SIZE)
    field = LensErrors(residual=0.5).displacements(rig, seed=1)[1]
    change = 1e-4 * np.eye(8)[term]
    moved = with_terms(rig, change)
    assert field is not None and rig.right is not None and moved.right is not None
    bearings = rig.right.unproject(pixel_grid(rig.right))
    turned = bearings @ rig.left_T_right[:3, :3].T @ moved.left_T_right[:3, :3]
    derivative = moved.right.project(turned) - rig.right.project(bearings)
    if np.nanmax(np.abs(derivative)) < 1e-9:
        return  # the direction of the baseline, of which points at infinity show nothing
    kept = np.isfinite(derivative).all(-1) & np.isfinite(field).all(-1)
    cosine = (field[kept] * derivative[kept]).sum() / np.linalg.norm(field[kept]) / np.linalg.norm(derivative[kept])
    assert abs(cosine) < 0.01


def test_a_pixel_shows_what_the_calibration_expects_where_the_error_says() -> None:
    rig = make_rig("pinhole", SIZE)
    field = LensErrors(residual=2.0).displacements(rig, seed=0)[0]
    assert field is not None
    bent = store(camera="pinhole", effects=False, residual=2.0).frame(40).left
    at = (pixel_grid(rig.left) + field).astype(np.float32)
    warped = cv2.remap(plain().left, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    inner = (slice(10, -10), slice(10, -10))
    off = np.abs(bent[inner].astype(float) - warped[inner]).mean()
    assert off < 0.4 * np.abs(bent[inner].astype(float) - plain().left[inner]).mean()


def test_without_errors_the_images_have_the_same_bits() -> None:
    assert LensErrors().displacements(make_rig("fisheye", SIZE), seed=0) == [None, None]
    none = dict.fromkeys(("residual", "decentered", "tilted", "rows", "right_blur", "stamp_jitter_ms", "stamped"), 0)
    a, b = store().frame(7), store(**none, right_exposure=1).frame(7)
    assert (a.left == b.left).all() and a.right is not None and b.right is not None and (a.right == b.right).all()
    assert a.stamp_ns == b.stamp_ns


def test_the_right_camera_has_its_own_exposure_and_focus() -> None:
    a, b = store(noise=0).frame(7), store(noise=0, right_exposure=0.5, right_blur=2.0).frame(7)
    assert a.right is not None and b.right is not None and (a.left == b.left).all()
    assert b.right.mean() == pytest.approx(0.5 * a.right.mean(), rel=0.1)
    contrast = [float(cv2.Laplacian(image, cv2.CV_64F).std() / image.mean()) for image in (a.right, b.right)]
    assert contrast[1] < 0.3 * contrast[0]


def test_stamps_may_be_those_of_another_rate_or_jitter() -> None:
    true, fast, late = store(rate=10), store(rate=10, stamped=30), store(rate=10, stamp_jitter_ms=10)
    ids = range(60)
    assert np.allclose(np.diff([fast.stamp_ns(k) for k in ids]), 1e9 / 30, atol=1)
    error = np.array([late.stamp_ns(k) - true.stamp_ns(k) for k in ids]) * 1e-6
    assert 7 < error.std() < 13 and abs(error.mean()) < 5
    assert (np.diff([store(rate=10, stamp_jitter_ms=1000).stamp_ns(k) for k in ids]) > 0).all()
    for source in (fast, late):  # the truth of a frame is where it was taken
        assert source.ground_truth is not None and true.ground_truth is not None
        assert (source.ground_truth.poses == true.ground_truth.poses).all()
        assert source.ground_truth.stamp_ns.tolist() == [source.stamp_ns(k) for k in ids]


def test_an_imu_with_stamps_of_another_rate_is_refused() -> None:
    with pytest.raises(StereoSfmError, match="stamped"):
        store(imu="ideal", stamped=15)
