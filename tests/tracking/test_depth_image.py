"""Points from depth images: holes of a coarser sensor are closed, edges are not."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.tracking.depth_image import points_from_depth
from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.stereo import StereoMatcher
from stereo_sfm.types import F32, F64

CAMERA = Pinhole(320, 240, 300.0, 300.0, 160.0, 120.0)
RIG = Rig(CAMERA, CAMERA, se3.from_rotation_translation(np.eye(3), np.array([0.08, 0.0, 0.0])), depth=True)


def _plane(slope: float) -> F32:
    """A slanted wall some two metres away."""
    v, u = np.mgrid[:240, :320]
    return (2.0 / (1.0 - slope * (u - 160) / 300 - slope * (v - 120) / 300)).astype(np.float32)


def _corners(seed: int) -> F64:
    return np.random.default_rng(seed).uniform((5, 5), (314, 234), (500, 2))


@pytest.mark.parametrize("hole", [0.0, np.nan])
@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_lines_of_holes_are_closed(hole: float, slope: float) -> None:
    whole = _plane(slope)
    holed = whole.copy()
    holed[::3], holed[:, 1::4] = hole, hole
    uv = _corners(1)
    points, uv_right = points_from_depth(RIG, holed, uv)
    expected, _ = points_from_depth(RIG, whole, uv)
    assert np.isfinite(points).all() and np.isfinite(expected).all()
    assert np.abs(points[:, 2] / expected[:, 2] - 1).max() < 1e-3
    disparity = uv[:, 0] - uv_right[:, 0]
    assert np.abs(disparity / (300 * 0.08 / expected[:, 2]) - 1).max() < 5e-3


@pytest.mark.parametrize("width", [0, 1, 2, 6])
def test_nothing_is_made_up_at_an_edge(width: int) -> None:
    """A near box before a wall, and the shadow of the projector beside it."""
    depth = _plane(0.0)
    depth[:, :100] = 1.0
    depth[:, 100 : 100 + width] = 0.0
    v = np.linspace(5, 234, 60)
    for u in (98.6, 99.0, 99.4, 100.0, 100.4 + width, 100.0 + width / 2):
        points, _ = points_from_depth(RIG, depth, np.column_stack([np.full(60, u), v]))
        assert not np.isfinite(points).any(), u
    for u, expected in ((97.0, 1.0), (102.0 + width, 2.0)):
        points, _ = points_from_depth(RIG, depth, np.column_stack([np.full(60, u), v]))
        assert points[:, 2] == pytest.approx(expected, rel=1e-6)


def test_large_holes_stay_holes() -> None:
    depth = _plane(0.2)
    depth[100:140, 100:200] = 0.0
    points, uv_right = points_from_depth(RIG, depth, np.array([[150.0, 120.0], [150.0, 101.0], [150.0, 98.0]]))
    assert np.isfinite(points[:, 0]).tolist() == np.isfinite(uv_right[:, 0]).tolist() == [False, False, True]


def test_points_of_a_depth_camera_pass_all_day() -> None:
    """Their right pixels are computed: they lie on the epipolar curves exactly, from which no scatter is learned."""
    matcher, depth = StereoMatcher(TrackerConfig(), RIG), _plane(0.2)
    left = klt.build_pyramid(np.zeros((240, 320), np.uint8), TrackerConfig().pyramid_levels)
    uv = _corners(3)[:300]
    first = int(matcher.match(left, depth, uv).good.sum())
    for _ in range(1000):
        last = int(matcher.match(left, depth, uv).good.sum())
    assert first == last > 250
