"""Two cameras whose images have two sizes: read, tracked, and doubted where the sizes differ too much for matching."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.calib import Rig, save_rig
from stereo_sfm.calib.lens_doubts import doubts
from stereo_sfm.calib.rectification import rectify
from stereo_sfm.drivers import open_source
from stereo_sfm.drivers.choice import SourceChoice
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.system import Tracker
from stereo_sfm.types import U8, StereoImage, Trajectory


def scaled(rig: Rig, scale: float) -> Rig:
    """With another size of the right images; pixel centres are whole numbers."""
    right = rig.right
    assert right is not None
    width, height = round(scale * right.width), round(scale * right.height)
    x, y = width / right.width, height / right.height
    return replace(rig, right=replace(
        right, width=width, height=height, fx=x * right.fx, fy=y * right.fy, cx=x * (right.cx + 0.5) - 0.5,
        cy=y * (right.cy + 0.5) - 0.5,
    ))  # fmt: skip


def resized(image: StereoImage, rig: Rig) -> U8:
    assert image.right is not None and rig.right is not None
    return np.asarray(cv2.resize(image.right, rig.right.size, interpolation=cv2.INTER_AREA), np.uint8)


def moved(truth: Trajectory) -> float:
    return float(np.linalg.norm((se3.inverse(truth.poses[0]) @ truth.poses[-1])[:3, 3]))


@pytest.mark.parametrize(("scale", "rectified"), [(0.75, False), (0.5, True)])
def test_the_motion_is_right(scale: float, rectified: bool) -> None:
    """Of images at half the scale after the rectification that the doubt asks for."""
    with open_source("sim:loop?size=212x200&frames=12&start=40") as source:
        images, truth = list(source), source.ground_truth
    assert truth is not None
    rig = scaled(source.rig, scale)
    assert any("'--rectify pinhole'" in doubt for doubt in doubts(rig)) == rectified
    views = rectify(rig, "epipolar")
    tracker = Tracker(views.rig if rectified else rig)
    found = 0.0
    for image in images:
        pair = image.left, resized(image, rig)
        pose = tracker.step(*(views.apply(*pair) if rectified else pair), image.stamp_ns).odom_T_cam
        found = float(np.linalg.norm(pose[:3, 3]))
    assert found == pytest.approx(moved(truth), rel=0.05)


def test_folders_of_two_sizes(tmp_path: Path) -> None:
    with open_source("sim:loop?size=212x200&frames=3") as source:
        images, rig = list(source), scaled(source.rig, 0.75)
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / "left" / f"{k:06d}.png"), image.left)
        cv2.imwrite(str(tmp_path / "right" / f"{k:06d}.png"), resized(image, rig))
    save_rig(rig, tmp_path / "rig.yaml")
    with open_source(tmp_path) as source:
        read = list(source)
    assert [(i.left.shape, i.right.shape) for i in read if i.right is not None] == [((200, 212), (150, 159))] * 3
    save_rig(scaled(rig, 1 / 0.75), tmp_path / "rig.yaml")
    with pytest.raises(StereoSfmError, match="is 159x150 but the calibration is for 212x200"):
        open_source(tmp_path)


def test_sizes_are_doubted_where_the_images_stay_as_they_are(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with open_source("sim:loop?size=212x200&frames=2") as source:
        images, rig = list(source), scaled(source.rig, 0.5)
    for k, image in enumerate(images):
        for side, pixels in (("left", image.left), ("right", resized(image, rig))):
            (tmp_path / side).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / side / f"{k:06d}.png"), pixels)
    save_rig(rig, tmp_path / "rig.yaml")
    for how in ("none", "wide"):
        caplog.clear()
        with caplog.at_level(logging.WARNING, "stereo_sfm"), SourceChoice.of(tmp_path, rectify=how)():
            assert ("0.5 times as large" in caplog.text) == (how == "none")
