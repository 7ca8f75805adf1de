"""Where points may lie: off the rim of a fisheye's image, whatever the scene shows."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.geometry.cameras import Camera, Pinhole
from stereo_sfm.tracking.flow.visible_area import VisibleArea
from stereo_sfm.types import F64, U8
from tests.synthetic import fisheye_rig


def angles(camera: Camera) -> F64:
    """(H / 2, W / 2) degrees from the axis."""
    with np.errstate(invalid="ignore"):
        return np.degrees(np.arccos(np.clip(camera.bearing_grid(2)[..., 2], -1, 1)))


def half_image(camera: Camera, rim_deg: float, brightness: float, seed: int = 0) -> U8:
    """Noise up to the rim, black beyond."""
    angle = angles(camera)
    scene = np.random.default_rng(seed).uniform(0.2, 1.0, angle.shape) * brightness
    return np.where(angle < rim_deg, scene, 2).astype(np.uint8)


@pytest.mark.parametrize("rim_deg", [72.0, 80.0])
def test_points_avoid_the_rim(rim_deg: float) -> None:
    camera = fisheye_rig().left
    area = VisibleArea(camera, 88.0)
    before = area.mask
    area.learn(half_image(camera, rim_deg, 160))
    angle = angles(camera)
    assert before[(angle > rim_deg) & (angle < 85)].any()
    assert not area.mask[angle > rim_deg - 1.5].any()
    assert area.mask[before & (angle < rim_deg - 8)].all()
    v, u = np.nonzero(np.abs(angle - rim_deg) < 1)
    assert not area.inside(2.0 * np.stack([u, v], 1)).any()
    assert area.inside(np.array([[camera.cx, camera.cy], [np.nan, 5.0]])).tolist() == [True, False]


def test_a_dark_scene_is_not_taken_for_the_rim() -> None:
    camera = fisheye_rig().left
    area = VisibleArea(camera, 88.0)
    before = area.mask
    area.learn(np.zeros_like(half_image(camera, 80, 100)))
    assert (area.mask == before).all()
    area.learn(half_image(camera, 70, 160))
    area.learn(half_image(camera, 85, 160))  # what is lit once belongs to the image
    assert area.mask[before & (angles(camera) < 77)].all()


@pytest.mark.parametrize("first", ["dark", "bright"])
def test_a_dark_image_says_nothing_of_the_rim(first: str) -> None:
    """The lamps go out, or the exposure has not settled: the noise of black is as bright beyond the rim as within."""
    camera = fisheye_rig().left
    area = VisibleArea(camera, 88.0)
    dark = np.random.default_rng(0).integers(0, 4, half_image(camera, 80, 100).shape).astype(np.uint8)
    for image in [dark, half_image(camera, 72, 160)][:: 1 if first == "dark" else -1]:
        area.learn(image)
    assert not area.mask[angles(camera) > 70.5].any()


def test_a_bright_centre_does_not_make_the_rim_narrower() -> None:
    """A dim aisle, then a door to the daylight in its middle."""
    camera = fisheye_rig().left
    area = VisibleArea(camera, 88.0)
    area.learn(half_image(camera, 85, 60))
    before = area.mask
    area.learn(np.where(angles(camera) < 65, 250, 20).astype(np.uint8))
    assert (area.mask == before).all()


def test_narrow_lenses_have_no_rim() -> None:
    camera = Pinhole(640, 480, 400, 400, 320, 240)
    area = VisibleArea(camera, 88.0)
    before = area.mask
    area.learn(np.zeros((240, 320), np.uint8))
    assert (area.mask == before).all()
    assert area.inside(np.array([[2.0, 2.0], [638.0, 478.0], [-1.0, 20.0]])).tolist() == [True, True, False]
