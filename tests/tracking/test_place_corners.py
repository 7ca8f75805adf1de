"""Corners for place recognition: detected again from another pose, with depth, independent of the tracker."""

from __future__ import annotations

import dataclasses
from itertools import islice, pairwise

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import load
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.geometry import se3
from stereo_sfm.maps.single_image import still_keyframe
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.tracking.flow.keyframes import FIRST, SPACING
from stereo_sfm.tracking.flow.visible_area import cells_of
from stereo_sfm.types import F32, F64, U8, Corners, Keyframe, StereoImage

SOURCE = "sim:loop?size=424x400&rate=10"


@pytest.fixture(scope="module")
def sequence() -> SimSource:
    source = open_source(SOURCE)
    assert isinstance(source, SimSource)
    return source


def keyframe_at(sequence: SimSource, row: int) -> tuple[Keyframe, F64]:
    assert sequence.ground_truth is not None
    keyframe = still_keyframe(sequence.frame(int(sequence.frame_ids[row])), sequence.rig)
    assert keyframe is not None
    return keyframe, sequence.ground_truth.poses[row]


def share_found_again(rig: Rig, b_T_a: F64, a: Corners, uv_b: F32, descriptors_b: U8) -> float:
    """Share of the corners in the view of b with a similar one within 3 px of their projection."""
    uv = rig.left.project(se3.transform(b_T_a, a.points_cam.astype(np.float64)))
    width, height = rig.left.size
    with np.errstate(invalid="ignore"):
        inside = np.flatnonzero((uv > 30).all(1) & (uv[:, 0] < width - 30) & (uv[:, 1] < height - 30))
    found = 0
    for k in inside:
        near = np.abs(uv_b - uv[k]).max(axis=1) < 3
        bits = np.unpackbits(descriptors_b[near] ^ a.descriptors[k], axis=1).sum(axis=1)
        found += bool((bits <= 60).any())
    return found / len(inside)


@pytest.mark.parametrize("rows", [(40, 42), (100, 103), (200, 198)])
def test_corners_are_found_again_a_step_further(sequence: SimSource, rows: tuple[int, int]) -> None:
    (a, world_T_a), (b, world_T_b) = (keyframe_at(sequence, row) for row in rows)
    b_T_a = se3.inverse(world_T_b) @ world_T_a
    assert 0.1 < se3.extent(b_T_a)[0] < 0.5
    assert min(len(a.corners), len(b.corners)) > 250
    assert share_found_again(sequence.rig, b_T_a, a.corners, b.corners.uv_left, b.corners.descriptors) > 0.4


def test_corners_lie_all_over_the_image_and_have_depth(sequence: SimSource) -> None:
    corners = keyframe_at(sequence, 40)[0].corners
    assert len(np.unique(cells_of(corners.uv_left.astype(np.float64), sequence.rig.left.size))) > 20
    assert np.isfinite(corners.points_cam).all() and np.isfinite(corners.uv_right).all()
    assert sequence.rig.right is not None
    right = sequence.rig.project_right(corners.points_cam)
    assert np.percentile(np.linalg.norm(right - corners.uv_right, axis=1), 90) < 1.0


def run(*overrides: str) -> list[Keyframe]:
    with open_source(SOURCE) as source:
        tracker = make_tracker(load(overrides=overrides), source.rig)
        keyframes = (tracker.step(image)[1] for image in islice(source, 40))
        return [tracker.describe(keyframe) for keyframe in keyframes if keyframe is not None]


def test_corners_change_nothing_for_the_tracker_and_odometry_alone_has_none() -> None:
    with_corners, without = run(), run("mapper.enabled=false", "loop.enabled=false")
    described = [k for k in with_corners if len(k.corners)]  # others look like the keyframe before
    assert len(described) >= 3 and all(len(k.corners) > 200 for k in described)
    for a, b in zip(with_corners, without, strict=True):
        assert not len(b.corners)
        for name in ("odom_T_cam", "point_ids", "uv_left", "uv_right", "points_cam", "descriptors"):
            assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)


def test_corners_do_not_depend_on_the_tracker() -> None:
    by_flow, by_descriptors = run()[0], run("odometry.method=r-um", "features.kind=orb")[0]
    for a, b in zip(dataclasses.astuple(by_flow.corners), dataclasses.astuple(by_descriptors.corners), strict=True):
        assert len(a) > 200 and np.array_equal(a, b)


def test_a_black_image_has_none(sequence: SimSource) -> None:
    image = sequence.frame(int(sequence.frame_ids[0]))
    dark = np.zeros_like(image.left)
    assert still_keyframe(dataclasses.replace(image, left=dark, right=dark.copy()), sequence.rig) is None


def test_a_black_right_image_gives_no_corners(sequence: SimSource) -> None:
    image = sequence.frame(int(sequence.frame_ids[40]))
    covered = StereoImage(0, 0, image.left, np.full_like(image.left, 90))
    keyframe = still_keyframe(covered, sequence.rig)
    assert keyframe is None or len(keyframe.corners) < 10


def test_places_are_described_where_the_view_has_changed(sequence: SimSource) -> None:
    """Every frame is made a keyframe: some of them share one description, and none is far from one."""
    config = load()
    config = dataclasses.replace(config, tracker=dataclasses.replace(config.tracker, keyframe_max_frames=1))
    tracker, keyframes = make_tracker(config, sequence.rig), list[Keyframe]()
    for image in islice(sequence, 40):
        _, keyframe = tracker.step(image)
        assert keyframe is not None
        keyframes.append(tracker.describe(keyframe))
    described = [k for k in keyframes if k.described]
    assert all(k.described for k in keyframes[:FIRST]) and FIRST + 4 < len(described) < 20
    for a, b in pairwise(described[FIRST - 1 :]):
        metres, radians = se3.extent(se3.inverse(a.odom_T_cam) @ b.odom_T_cam)
        distance = np.median(np.linalg.norm(a.corners.points_cam, axis=1))
        assert metres >= SPACING[0] * distance or radians >= SPACING[1]
        assert metres < SPACING[0] * distance + 0.2
