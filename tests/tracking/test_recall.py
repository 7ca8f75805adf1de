"""How much of the view from a hypothetical pose is what was seen before."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.config import TrackerConfig
from stereo_sfm.drivers.sim.rigs import make_rig
from stereo_sfm.tracking.flow.consensus import Movers
from stereo_sfm.tracking.flow.follower import Follower
from stereo_sfm.tracking.flow.klt import Pyramid, StereoPyramids, build_pyramid
from stereo_sfm.tracking.flow.new_points import NewPoints
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo import StereoMatch, StereoMatcher
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.tracking.flow.visible_area import VisibleArea
from stereo_sfm.types import F32, F64, Bool

RIG = make_rig("pinhole")
WIDTH, HEIGHT = RIG.left.size
DISTANCE = 3.0


def view() -> tuple[Follower, F64, Bool]:
    """The reference points, (N, 2) px: 600 on the ceiling, in the upper half of the image, and 100 on shelves below."""
    rng = np.random.default_rng(0)
    low, high = np.array([40.0, 40.0]), np.array([WIDTH - 40.0, HEIGHT - 40.0])
    middle = 0.5 * HEIGHT
    uv = np.concatenate(
        [rng.uniform(low, [high[0], middle], (600, 2)), rng.uniform([low[0], middle + 1], high, (100, 2))]
    )
    n = len(uv)
    tracks = Tracks(
        point_ids=np.arange(n),
        uv=uv,
        uv_right=np.full((n, 2), np.nan),
        right_offset=np.zeros((n, 2)),
        disagreed=np.zeros(n, bool),
        origin=np.zeros((n, 3)),
        direction=RIG.left.unproject(uv),
        rho=np.full(n, 1 / DISTANCE),
        variance=np.full(n, 1e-5),
        age=np.zeros(n, np.int32),
        misses=np.zeros(n, np.int32),
        warp=np.tile(np.eye(2), (n, 1, 1)),
        slot=np.arange(n),
        moving=np.zeros(n, bool),
        mapped=np.zeros(n, bool),
    )
    config, shutter = TrackerConfig(), RollingShutter(RIG)
    follower = Follower(config, RIG, VisibleArea(RIG.left, config.max_angle_deg, None), shutter)
    follower.refer_to(StereoPyramids((), ()), tracks, np.ones(n, bool), np.eye(4), np.eye(4))
    return follower, uv, uv[:, 1] <= middle


def corners(uv: F64, metres: float) -> F64:
    """(N, 3) corners of the image at a distance from the camera."""
    return metres * RIG.left.unproject(uv)


def test_a_ceiling_is_its_part_of_the_view_however_many_points_it_has() -> None:
    follower, uv, ceiling = view()
    assert follower.recall(uv, np.eye(4)) == pytest.approx(1.0)
    assert follower.recall(uv[ceiling], np.eye(4)) < 0.6 < 0.8 < ceiling.mean()
    assert follower.recall(uv[:0], np.eye(4)) == 0.0


def test_what_something_nearer_covers_does_not_count() -> None:
    """A shelf with other goods contradicts a pose; a person in front of it says nothing."""
    follower, uv, ceiling = view()
    away = np.where(ceiling, DISTANCE, 0.4)[:, None] * RIG.left.unproject(uv)
    assert follower.recall(uv[ceiling], np.eye(4), away) > 0.95
    assert follower.recall(uv[ceiling], np.eye(4), corners(uv, DISTANCE)) < 0.6


def test_with_one_lens_covered_the_whole_view_counts() -> None:
    follower, uv, ceiling = view()
    assert follower.recall(uv, np.eye(4), np.zeros((0, 3))) == pytest.approx(1.0)
    assert follower.recall(uv[ceiling], np.eye(4), np.zeros((0, 3))) < 0.6


def test_a_small_part_of_the_view_is_little_evidence() -> None:
    follower, uv, _ = view()
    cell = uv // [WIDTH / 8, HEIGHT / 6]
    few = (cell[:, 0] // 2 == 1) & (cell[:, 1] == 1)  # two cells
    hidden = np.where(few, DISTANCE, 0.4)[:, None] * RIG.left.unproject(uv)
    assert follower.recall(uv[few], np.eye(4), hidden) > 0.9
    assert follower.recall(uv[few], np.eye(4), hidden, 12.0) < 0.5


class TooFar(StereoMatcher):
    """Noise puts all points behind the camera."""

    def match(self, left: Pyramid, right: Pyramid | F32, uv: F64, needed: int = 0) -> StereoMatch:
        n = len(uv)
        return StereoMatch(
            uv, uv, RIG.left.unproject(uv), np.full(n, -1e-6), np.ones(n), np.zeros((n, 2)), np.ones(n, bool)
        )


def test_corners_that_noise_puts_behind_the_camera_are_far_away() -> None:
    follower, uv, _ = view()
    config, shutter = TrackerConfig(), RollingShutter(RIG)
    area = VisibleArea(RIG.left, config.max_angle_deg, None)
    new_points = NewPoints(config, area, TooFar(config, RIG), follower, shutter, Movers())
    image = build_pyramid(np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH)).astype(np.uint8), 4)
    seen = new_points.seen(StereoPyramids(image, image))
    assert len(seen) > 100
    assert follower.recall(uv, np.eye(4), seen) == pytest.approx(1.0)
