"""Masks of a rig: kept in files, obeyed by every detector, and found in recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.calib.formats.native import read_native, rig_from_text, rig_to_text, write_native
from stereo_sfm.calib.mask import encode_mask, half_size, read_mask, uncovered
from stereo_sfm.calib.mask_search import MaskSearch, masked
from stereo_sfm.calib.rectification import rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.papers.feature_view import ViewMaker
from stereo_sfm.recording.describe import rig_lines
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.tracking.flow.place_corners import PlaceCorners
from stereo_sfm.types import Bool, StereoImage

SCENE = "sim:loop?camera=pinhole&size=320x200&rate=5"


def lower_half(rig: Rig) -> Bool:
    """All but the lower half of the left image."""
    mask = np.ones((rig.left.height, rig.left.width), bool)
    mask[rig.left.height // 2 :] = False
    return mask


@pytest.fixture(scope="module")
def images() -> tuple[Rig, list[StereoImage]]:
    with open_source(SCENE + "&frames=4") as source:
        return source.rig, list(source)


def test_rig_file_keeps_masks(images: tuple[Rig, list[StereoImage]], tmp_path: Path) -> None:
    rig = replace(images[0], left_mask=lower_half(images[0]))
    write_native(rig, tmp_path / "rig.yaml")
    again = read_native(tmp_path / "rig.yaml")
    assert again.left_mask is not None and np.array_equal(again.left_mask, lower_half(rig)) and again.right_mask is None
    assert rig_to_text(again) == rig_to_text(rig)
    assert "50 % masked" in rig_lines(again)[0] and "masked" not in " ".join(rig_lines(images[0]))


def test_a_rig_file_names_a_mask_file_in_its_folder(images: tuple[Rig, list[StereoImage]], tmp_path: Path) -> None:
    rig = images[0]
    (tmp_path / "left.png").write_bytes(encode_mask(lower_half(rig)))
    head, _, tail = rig_to_text(rig).partition("left:\n")
    text = f"{head}left:\n  mask: left.png\n{tail}"
    (tmp_path / "rig.yaml").write_text(text)
    read = read_native(tmp_path / "rig.yaml")
    assert read.left_mask is not None and np.array_equal(read.left_mask, read_mask(tmp_path / "left.png"))
    with pytest.raises(StereoSfmError, match="not PNG data"):
        rig_from_text(text, "a log")  # a log names no files
    (tmp_path / "left.png").unlink()
    with pytest.raises(StereoSfmError, match=r"cannot read the mask .*left\.png"):
        read_native(tmp_path / "rig.yaml")


def test_unusable_masks_are_one_line(images: tuple[Rig, list[StereoImage]]) -> None:
    rig = images[0]
    with pytest.raises(StereoSfmError, match="100x50 px, its images 320x200"):
        replace(rig, left_mask=np.ones((50, 100), bool))
    with pytest.raises(StereoSfmError, match=r"right camera leaves 0\.0 %"):
        replace(rig, right_mask=np.zeros((200, 320), bool))


def test_no_detector_finds_corners_under_a_mask(images: tuple[Rig, list[StereoImage]]) -> None:
    rig, frames = images[0], images[1]
    covered = replace(rig, left_mask=lower_half(rig), right_mask=lower_half(rig))
    limit = rig.left.height / 2
    tracker = make_tracker(Config(), covered)
    for image in frames:
        frame, _ = tracker.step(image)
        assert len(frame.observations) > 30 and frame.observations.uv_left[:, 1].max() < limit
    corners = PlaceCorners(Config(), covered).find(frames[0])
    assert len(corners) > 20 and corners.uv_left[:, 1].max() < limit
    view = ViewMaker(Config().features, covered).make(frames[0], None, np.random.default_rng(0))
    assert len(view) > 20 and view.features.uv[:, 1].max() < limit


def test_mask_of_all_pixels_changes_no_bit(images: tuple[Rig, list[StereoImage]]) -> None:
    rig, frames = images
    everywhere = replace(rig, left_mask=np.ones((200, 320), bool), right_mask=np.ones((200, 320), bool))
    plain, covered = make_tracker(Config(), rig), make_tracker(Config(), everywhere)
    for image in frames:
        a, b = plain.step(image)[0], covered.step(image)[0]
        assert np.array_equal(a.odom_T_cam, b.odom_T_cam) and np.array_equal(
            a.observations.uv_left, b.observations.uv_left
        )


def test_rectified_rig_has_the_mask_where_its_pixels_come_from(images: tuple[Rig, list[StereoImage]]) -> None:
    rig = replace(images[0], left_mask=lower_half(images[0]))
    rectification = rectify(rig, "pinhole")
    mask = rectification.rig.left_mask
    assert mask is not None and mask[: int(0.45 * len(mask))].mean() > 0.95 and not mask[int(0.55 * len(mask)) :].any()
    assert rectification.rig.right_mask is None


def test_half_size_keeps_off_what_is_covered() -> None:
    mask = np.ones((20, 30), bool)
    mask[10, 15] = False
    half = half_size(mask)
    assert half.shape == (10, 15) and not half[5, 7] and not half[5, 8] and half[3, 3]
    assert uncovered(mask, 2)[12, 18] and not uncovered(mask, 2)[12, 17]


def searched(spec: str) -> tuple[MaskSearch, SimSource]:
    """Images all along a scene's path, with their true rotations."""
    source, search = open_source(spec), MaskSearch()
    assert isinstance(source, SimSource)
    for frame_id in source.frame_ids[::8].tolist():
        image = source.frame(frame_id)
        assert image.right is not None
        search.add((image.left, image.right), source.pose(frame_id)[:3, :3])
    return search, source


def test_robot_in_view_is_found() -> None:
    search, source = searched(SCENE + "&robot=true&frames=400")
    found = search.find()
    rig = masked(source.rig, found)
    for mask, sensor in zip((rig.left_mask, rig.right_mask), source._sensors, strict=True):  # pyright: ignore[reportPrivateUsage]
        assert mask is not None and sensor.robot is not None
        robot = cv2.erode(sensor.robot.covered.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        assert mask[robot].mean() < 0.01  # of the robot is left
        assert mask[~sensor.robot.covered].mean() > 0.95  # of the world stays


def test_plain_parts_thinner_than_a_window_are_found() -> None:
    rng = np.random.default_rng(0)
    rail = np.zeros((120, 160), bool)
    rail[:, 80:84] = True
    look = np.where(np.arange(120)[:, None] % 60 < 30, rng.integers(40, 200, (120, 160)), 110)  # every other part plain
    search = MaskSearch()
    for k in range(20):
        scene = cv2.GaussianBlur(rng.integers(0, 256, (120, 160)).astype(np.uint8), (5, 5), 0)
        image = np.where(rail, look + rng.integers(-2, 3, rail.shape), scene).astype(np.uint8)
        turned = cv2.Rodrigues(np.array([0.0, 0.3 * k, 0.0]))[0]
        search.add((image,), turned)
    used = search.find()[0].used
    assert not used[rail].any()
    assert used[~rail].mean() > 0.97


def test_the_scene_is_not_masked() -> None:
    search, _ = searched(SCENE + "&frames=400")
    assert all(not found.fixed.any() and found.used.all() for found in search.find())


def test_a_recording_without_turns_is_rejected() -> None:
    search, _ = searched("sim:aisle?camera=pinhole&size=320x200&rate=5&frames=60")
    assert not search.turned
    with pytest.raises(StereoSfmError, match="record a drive with a turn"):
        search.find()


def test_found_mask_keeps_points_off_the_robot() -> None:
    search, source = searched(SCENE + "&robot=true&frames=400")
    robot = source._sensors[0].robot  # pyright: ignore[reportPrivateUsage]
    assert robot is not None
    features = replace(Config().features, stereo_only=False)
    image, on_robot = source.frame(0), dict[str, int]()
    for name, rig in {"unmasked": source.rig, "masked": masked(source.rig, search.find())}.items():
        uv = ViewMaker(features, rig).make(image, None, np.random.default_rng(0)).features.uv
        u, v = np.rint(uv).astype(int).T
        on_robot[name] = int(robot.covered[v, u].sum())
        assert len(uv) > 200
    assert on_robot["masked"] == 0 and on_robot["unmasked"] > 50
