"""Moving objects: static points determine the pose, moving points are marked."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from stereo_sfm.config import TrackerConfig
from stereo_sfm.drivers.sim.rigs import make_rig
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow import frame_pose
from stereo_sfm.tracking.flow.consensus import Movers, after_frame, static_frames
from stereo_sfm.tracking.flow.frame_pose import ExpectedMotion, FramePoseSolver
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64, Bool

RIG = make_rig("pinhole")
SECONDS = 1 / 15
STATIC = static_frames(SECONDS)
MOVED = se3.exp(np.array([0.0, 0.0, 0.055, 0.0, 0.002, 0.0]))  # of the camera since the last frame
STILL, MOVING = 60, 150


def scene(rng: np.random.Generator) -> tuple[Tracks, Bool]:
    """Settled points of the store and more new ones on a person who walks ahead of the camera at its speed."""
    store = rng.uniform([-2.0, -1.2, 2.5], [2.0, 1.2, 7.0], (STILL, 3))
    person = rng.uniform([-0.3, -0.4, 1.0], [0.3, 0.4, 1.3], (MOVING, 3))
    before = np.concatenate([store, person])
    now = np.concatenate([se3.transform(se3.inverse(MOVED), store), person])
    n = len(before)
    distance = np.linalg.norm(before, axis=1)
    assert RIG.right is not None
    uv = RIG.left.project(now) + rng.normal(0, 0.2, (n, 2))
    uv_right = RIG.project_right(now) + rng.normal(0, 0.2, (n, 2))
    on_person = np.arange(n) >= STILL
    tracks = Tracks(
        point_ids=np.arange(n, dtype=np.int64),
        uv=uv,
        uv_right=uv_right,
        right_offset=np.zeros((n, 2)),
        origin=np.zeros((n, 3)),
        direction=before / distance[:, None],
        rho=1 / distance,
        variance=np.full(n, 1e-5),
        age=np.where(on_person, 1, 20).astype(np.int32),
        misses=np.zeros(n, np.int32),
        warp=np.tile(np.eye(2), (n, 1, 1)),
        slot=np.arange(n, dtype=np.int64),
        mapped=np.zeros(n, bool),
        moving=np.zeros(n, bool),
        disagreed=np.zeros(n, bool),
    )
    return tracks, on_person


def put(rng: np.random.Generator, tracks: Tracks, before: F64, now: F64, noise_px: float = 0.2) -> None:
    """Points that were at `before` (N, 3) in the last frame's camera are seen at `now` (N, 3) in this one's."""
    distance = np.linalg.norm(before, axis=1)
    tracks.direction, tracks.rho = before / distance[:, None], 1 / distance
    tracks.uv = RIG.left.project(now) + rng.normal(0, noise_px, (len(now), 2))
    tracks.uv_right = RIG.project_right(now) + rng.normal(0, noise_px, (len(now), 2))


def off(pose: F64) -> float:
    """Metres from the truth."""
    return float(se3.extent(se3.inverse(MOVED) @ pose)[0])


@pytest.mark.parametrize("seed", range(5))
def test_settled_points_decide_against_more_young_ones(seed: int) -> None:
    tracks, on_person = scene(np.random.default_rng(seed))
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED @ se3.exp(np.full(6, 0.002)), np.zeros(6), SECONDS)
    solution = solver.solve(tracks, expected, np.eye(4), before=400)
    assert off(solution.pose) < 0.005
    assert solution.inlier[~on_person].mean() > 0.9
    assert solution.inlier[on_person].mean() < 0.15
    assert np.sqrt(np.trace(solution.covariance[:3, :3])) < 0.01
    solver.learn(tracks, solution, expected)
    assert solver.alert


def test_a_pose_that_more_points_support_is_taken_without_a_second_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Among people the solution with all points may end at a pose that is neither theirs nor the camera's."""
    tracks, on_person = scene(np.random.default_rng(0))
    tracks = tracks.keep(~on_person)
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED @ se3.exp(np.full(6, 0.002)), np.zeros(6), SECONDS)
    right = solver.solve(tracks, expected, np.eye(4))
    between = dataclasses.replace(right, error=np.where(np.arange(len(tracks)) < 0.6 * STILL, right.error, np.inf))
    between.pose = MOVED @ se3.exp(np.array([0.0, 0.0, -0.03, 0.0, 0.0, 0.0]))
    monkeypatch.setattr(solver, "_solve_all", lambda *_: between)  # pyright: ignore[reportUnknownLambdaType]
    assert off(solver.solve(tracks, expected, np.eye(4), before=STILL).pose) < 0.005


def test_the_motion_to_another_pose_begins_at_the_same_one() -> None:
    """Else the velocity of a rolling shutter stays that of the prediction."""
    last = se3.exp(np.array([0.3, -0.1, 2.0, 0.2, 0.4, -0.1]))
    predicted = np.array([0.0, 0.01, 0.1, 0.02, -0.03, 0.0])
    motion = ExpectedMotion(last @ se3.exp(predicted), predicted, 0.1).to(last @ MOVED)
    assert motion.pose == pytest.approx(last @ MOVED)
    assert motion.velocity == pytest.approx(se3.log(MOVED) / 0.1)


@pytest.mark.parametrize("seed", range(5))
def test_points_that_agree_with_both_motions_are_no_evidence_of_rest(seed: int) -> None:
    """A recording begins while the camera drives, six metres a second; of the far points one cannot tell."""
    rng, driven = np.random.default_rng(seed), se3.exp(np.array([0.0, 0.0, 0.6, 0.0, 0.005, 0.0]))
    tracks = scene(rng)[0].keep(np.arange(STILL + MOVING) < 130)
    far = np.arange(130) >= 100
    depth = np.where(far, rng.uniform(300.0, 600.0, 130), rng.uniform(6.0, 25.0, 130))
    before = depth[:, None] * np.column_stack([rng.uniform([-0.5, -0.3], [0.5, 0.3], (130, 2)), np.ones(130)])
    before[far] *= [0.2, 0.2, 1.0]
    put(rng, tracks, before, se3.transform(se3.inverse(driven), before), 0.1)
    tracks.age = np.zeros(130, np.int32)
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    solution = solver.solve(tracks, ExpectedMotion(np.eye(4), np.zeros(6), 0.1), np.eye(4), before=140)
    assert float(se3.extent(se3.inverse(driven) @ solution.pose)[0]) < 0.1
    assert not solution.moving.any() and solution.inlier.mean() > 0.9


@pytest.mark.parametrize("seed", range(5))
def test_a_start_in_traffic_is_no_rest(seed: int) -> None:
    """A car drives, points are far, another comes towards it: rest is a prediction without evidence."""
    rng, driven = np.random.default_rng(seed), se3.exp(np.array([0.0, 0.0, 0.6, 0.0, 0.002, 0.0]))
    tracks = scene(rng)[0].keep(np.arange(STILL + MOVING) < 130)
    other = np.arange(130) >= 115
    depth = np.where(other, rng.uniform(12.0, 14.0, 130), rng.uniform(13.0, 70.0, 130))
    at = np.where(other[:, None], rng.uniform([-0.3, 0.1], [-0.2, 0.2], (130, 2)), rng.uniform(-0.4, 0.4, (130, 2)))
    before = depth[:, None] * np.column_stack([at, np.ones(130)])
    now = se3.transform(se3.inverse(driven), before)
    now[other, 2] -= 0.6
    put(rng, tracks, before, now, 0.15)
    tracks.age, tracks.variance = np.zeros(130, np.int32), np.full(130, 0.004**2)
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    solution = solver.solve(tracks, ExpectedMotion(np.eye(4), np.zeros(6), 0.045), np.eye(4), before=130)
    assert float(se3.extent(se3.inverse(driven) @ solution.pose)[0]) < 0.2
    assert solution.inlier[~other].mean() > 0.8 and not solution.moving[~other].any()


def test_in_the_first_images_the_motion_of_far_points_is_tried() -> None:
    """Nobody was followed for long yet, and most points are on somebody near who walks and swings his arms."""
    turned, count, right = se3.exp(np.array([0.002, 0.0, 0.003, 0.0, 0.012, 0.0])), 75, 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        store = rng.uniform([-2.0, -1.2, 3.0], [2.0, 1.2, 6.0], (STILL, 3))
        person = rng.uniform([-0.6, -0.5, 1.2], [0.6, 0.5, 1.8], (count, 3))
        before = np.concatenate([store, person])
        moved = np.concatenate([store, person + rng.normal([0.045, 0.0, 0.0], 0.01, (count, 3))])
        tracks = scene(rng)[0].keep(np.arange(STILL + MOVING) < STILL + count)
        put(rng, tracks, before, se3.transform(se3.inverse(turned), moved))
        tracks.age = np.ones_like(tracks.age)
        solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
        at_rest = ExpectedMotion(np.eye(4), np.zeros(6), SECONDS)
        solution = solver.solve(tracks, at_rest, np.eye(4), before=len(tracks))
        right += se3.extent(se3.inverse(turned) @ solution.pose)[0] < 0.01  # by all points 0.06
    assert right >= 9


@pytest.mark.parametrize("seed", range(3))
def test_a_person_followed_for_as_long_as_the_store_does_not_take_the_pose_along(seed: int) -> None:
    """Who stood before the camera has the older points, and more of them; at the first step the camera goes on."""
    tracks, on_person = scene(np.random.default_rng(seed))
    tracks.age[:] = np.where(on_person, 60, 10)
    tracks.mapped[:] = on_person
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED @ se3.exp(np.full(6, 0.001)), se3.log(MOVED), SECONDS)
    solution = solver.solve(tracks, expected, np.eye(4), before=len(tracks))
    assert off(solution.pose) < 0.005
    assert solution.moving[on_person].mean() > 0.7
    assert not solution.moving[~on_person].any()


@pytest.mark.parametrize("seed", range(3))
def test_a_person_who_steps_aside_slowly_does_not_shift_the_pose(seed: int) -> None:
    """The store is far away: a camera that moved aside and turned a little would see nearly the same.

    The person has a third of the points, the nearest ones. All that speaks against that motion is the expected one.
    """
    rng = np.random.default_rng(seed)
    tracks, on_person = scene(rng)
    kept = np.arange(len(tracks)) < STILL + 30
    tracks, on_person = tracks.keep(kept), on_person[kept]
    before: F64 = np.where(on_person[:, None], tracks.points(), [0.0, 0.0, 4.0] + 0.15 * tracks.points())
    now = se3.transform(se3.inverse(MOVED), before + on_person[:, None] * [0.02, 0.0, 0.0])
    put(rng, tracks, before, now)
    tracks.age[:], tracks.mapped[:] = 60, True
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED @ se3.exp(np.full(6, 0.001)), se3.log(MOVED), SECONDS)
    solution = solver.solve(tracks, expected, np.eye(4), before=len(tracks))
    assert off(solution.pose) < 0.008
    assert solution.moving[on_person].mean() > 0.7
    assert not solution.moving[~on_person].any()


def before_one_wall(rng: np.random.Generator, age: int = 1) -> tuple[Tracks, Bool]:
    """Points of a wall, before which a turn looks like a shift, and newer ones on somebody near who sways: 8 mm.

    `age`: frames for which these were tracked.
    """
    store = rng.uniform([-1.6, -1.0, 2.2], [1.6, 1.0, 3.6], (220, 3))
    store = store[(np.abs(store[:, :2] / store[:, 2:]) > [0.22, 0.32]).any(axis=1)][:170]  # not hidden
    person = rng.uniform([-0.2, -0.3, 0.9], [0.2, 0.3, 1.0], (17, 3))
    before = np.concatenate([store, person])
    now = se3.transform(se3.inverse(MOVED), before)
    on_person = np.arange(len(before)) >= len(store)
    now[on_person, 0] += 0.008
    tracks = scene(rng)[0].keep(np.arange(STILL + MOVING) < len(before))
    put(rng, tracks, before, now, 0.25)
    tracks.variance = np.square(0.002 * tracks.rho)
    young = on_person | (np.arange(len(before)) < 40)
    tracks.age, tracks.mapped = np.where(young, age, 20).astype(np.int32), ~young
    return tracks, on_person


@pytest.mark.parametrize("age", [1, 10])
def test_new_points_on_somebody_who_sways_do_not_take_the_pose_along(monkeypatch: pytest.MonkeyPatch, age: int) -> None:
    """None of them is an outlier at the pose that they have shifted, for less than a second."""
    errors = list[tuple[float, float]]()
    for seed in range(40):
        tracks, on_person = before_one_wall(np.random.default_rng(seed), age)
        solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
        expected = ExpectedMotion(MOVED @ se3.exp(np.full(6, 0.001)), se3.log(MOVED), SECONDS)
        solution = solver.solve(tracks, expected, np.eye(4), before=len(tracks))
        assert not solution.moving[~on_person].any()
        with monkeypatch.context() as patch:
            patch.setattr(solver, "_contradicted", lambda *_: None)
            errors.append((off(solution.pose), off(solver.solve(tracks, expected, np.eye(4), before=len(tracks)).pose)))
    found, taken_along = np.array(errors).T
    assert np.count_nonzero(taken_along > 0.003) >= 5
    assert found.max() < 0.003


def test_new_points_among_moving_ones_are_not_believed_where_the_pose_rests_on_them() -> None:
    """Too few for a group, on somebody near, all of whose other points are marked. Some pull too little to be told."""
    mended = 0
    for seed in range(20):
        tracks, on_person = before_one_wall(np.random.default_rng(seed))
        tracks.moving = on_person & (np.arange(len(tracks)) < len(tracks) - 6)
        solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
        start = ExpectedMotion(MOVED @ se3.exp(np.full(6, 0.001)), se3.log(MOVED), SECONDS)
        taken_along = solver._solve_all(tracks, start, np.eye(4), ~tracks.moving)  # pyright: ignore[reportPrivateUsage]
        assert off(taken_along.pose) > 0.003
        mended += off(solver.solve(tracks, start, np.eye(4), before=len(tracks)).pose) < 0.003
    assert mended >= 12


def before_wrong_distances(rng: np.random.Generator) -> Tracks:
    """A car drives past what is near, towards what it has seen for 9 m, with a rig that is 0.05 degrees off."""
    tracks = scene(rng)[0]
    n, far = len(tracks), np.arange(len(tracks)) < 120
    depth = np.where(far, rng.uniform(25.0, 60.0, n), rng.uniform(5.0, 9.0, n))
    points = depth[:, None] * np.column_stack([rng.uniform([-0.5, -0.2], [0.5, 0.2], (n, 2)), np.ones(n)])
    tracks.origin = np.where(far[:, None], [0.0, 0.0, -9.0], [0.0, 0.0, -1.0])
    distance = np.linalg.norm(points - tracks.origin, axis=1)
    tracks.direction = (points - tracks.origin) / distance[:, None]
    tracks.rho = 1 / distance + math.radians(0.05) / RIG.baseline
    tracks.variance, tracks.age = np.full(n, 1e-6), np.where(far, 15, 1).astype(np.int32)
    tracks.uv, tracks.uv_right = RIG.left.project(points) + rng.normal(0, 0.2, (n, 2)), np.full((n, 2), np.nan)
    return tracks


def test_an_error_of_the_rig_is_not_somebody_near_who_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that were tracked for long contradict new near points, by as much as distances err together."""
    for seed in range(10):
        tracks = before_wrong_distances(np.random.default_rng(seed))
        expected = ExpectedMotion(se3.exp(np.full(6, 0.001)), se3.log(MOVED), SECONDS)
        solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
        assert not solver.solve(tracks, expected, np.eye(4), before=len(tracks)).moving.any()
        with monkeypatch.context() as patch:
            patch.setattr(frame_pose, "RIG_SIGMA", 0.0)
            assert solver.solve(tracks, expected, np.eye(4), before=len(tracks)).moving.any()


def few_points(rng: np.random.Generator, moved: F64) -> Tracks:
    """14 distant points in a part of the view; the first of four near ones is found 60 px from where it is."""
    before = rng.uniform([-4.0, -1.0, 5.0], [-2.0, 0.5, 8.0], (18, 3))
    before[14:] = rng.uniform([0.0, -0.1, 0.6], [0.3, 0.2, 0.9], (4, 3))
    tracks = scene(rng)[0].keep(np.arange(STILL + MOVING) < 18)
    put(rng, tracks, before, se3.transform(se3.inverse(moved), before))
    tracks.variance, tracks.age = np.square(0.01 * tracks.rho), np.ones(18, np.int32)
    tracks.uv_right[14:] = np.nan
    tracks.uv[14] += 60.0 * se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, rng.uniform(0.0, 6.3)]))[:2, 0]
    return tracks


def test_a_near_point_at_a_wrong_pixel_does_not_take_the_pose_along(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few points far away leave the position so free that a near one with less than a pixel of error is believed."""
    taken_along = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        moved = MOVED @ se3.exp(rng.normal(0.0, 0.005, 6))
        tracks = few_points(rng, moved)
        solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
        expected = ExpectedMotion(MOVED, se3.log(MOVED), SECONDS)
        wrong = solver._optimise(tracks, expected, np.arange(18) < 15)  # pyright: ignore[reportPrivateUsage]
        if not wrong.inlier[14]:
            continue
        taken_along += 1
        assert float(se3.extent(se3.inverse(moved) @ wrong.pose)[0]) > 0.05
        monkeypatch.setattr(solver, "_solve_all", lambda *_, wrong=wrong: wrong)  # pyright: ignore
        solution = solver.solve(tracks, expected, np.eye(4), before=60)
        assert float(se3.extent(se3.inverse(moved) @ solution.pose)[0]) < 0.01
        assert not solution.inlier[14] and solution.inlier.sum() >= 16
    assert taken_along >= 15


def test_a_near_point_that_the_others_allow_keeps_its_say() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        tracks = few_points(rng, MOVED).keep(~np.isin(np.arange(18), (14, 16, 17)))
        solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
        solution = solver.solve(tracks, ExpectedMotion(MOVED, se3.log(MOVED), SECONDS), np.eye(4), before=60)
        assert solution.inlier[14] and off(solution.pose) < 0.01


def test_the_degrees_of_freedom_of_a_pose_are_shared_by_its_points() -> None:
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    tracks = scene(np.random.default_rng(0))[0].keep(np.arange(STILL + MOVING) < STILL)
    solution = solver.solve(tracks, ExpectedMotion(MOVED, se3.log(MOVED), SECONDS), np.eye(4))
    leverages = solver.influence(tracks, solution)[0]
    assert leverages.sum() == pytest.approx(6.0, rel=0.1) and leverages.max() < 0.5
    assert leverages.argmax() in np.argsort(tracks.rho)[-10:]


def test_errors_at_a_pose_by_others_are_as_large_as_expected() -> None:
    """With noise as assumed of pixels and distances, of points near and far."""
    squared, config = list[float](), TrackerConfig()
    solver = FramePoseSolver(config, StereoCameras.of(RIG), RollingShutter(RIG))
    for seed in range(300):
        rng = np.random.default_rng(seed)
        tracks = few_points(rng, MOVED).keep(np.arange(18) != 14)
        extra = np.sqrt(config.sigma_px**2 - 0.2**2)
        tracks.uv, tracks.uv_right = (uv + rng.normal(0, extra, (17, 2)) for uv in (tracks.uv, tracks.uv_right))
        tracks.rho = tracks.rho * (1 + rng.normal(0, 0.01, 17))
        start = ExpectedMotion(MOVED, se3.log(MOVED), SECONDS)
        solution = solver._optimise(tracks, start, np.arange(17) < 14)  # pyright: ignore[reportPrivateUsage]
        squared += np.square(solver.influence(tracks, solution)[1][14:]).tolist()
    assert 0.4 < np.mean(squared) < 1.2


def test_a_smaller_group_that_moves_is_marked_at_once() -> None:
    tracks, on_person = scene(np.random.default_rng(1))
    fewer = np.arange(len(tracks)) < STILL + 50
    tracks, on_person = tracks.keep(fewer), on_person[fewer]
    tracks.age[:] = 0  # no point is known for long: most decide
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED @ se3.exp(np.full(6, 0.002)), np.zeros(6), SECONDS)
    solution = solver.solve(tracks, expected, np.eye(4), before=len(tracks))
    assert off(solution.pose) < 0.005
    assert solution.moving[on_person].mean() > 0.7
    assert not solution.moving[~on_person].any()
    solver.learn(tracks, solution, expected)
    assert solver.alert


def test_too_little_of_an_open_view_is_no_pose() -> None:
    tracks, on_person = scene(np.random.default_rng(2))
    store = tracks.keep(~on_person)
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED, np.zeros(6), SECONDS)
    solver.learn(store, solver.solve(store, expected, np.eye(4), before=STILL), expected)
    assert not solver.alert
    assert solver.open_view > 0.9 * STILL
    solver.learn(tracks, solver.solve(tracks, expected, np.eye(4), before=400), expected)
    assert solver.alert
    seen = on_person | (np.arange(len(tracks)) >= STILL - 9)
    left = tracks.keep(seen)
    assert solver.solve(left, expected, np.eye(4), before=400).reason


@pytest.mark.parametrize(("metres", "found"), [(0.0, True), (0.05, False)])
def test_few_points_of_an_open_view_are_believed_only_for_a_usual_motion(metres: float, found: bool) -> None:
    tracks, on_person = scene(np.random.default_rng(3))
    few = tracks.keep(~on_person & (np.arange(len(tracks)) < 25))
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    solver.open_view = 200.0
    expected = ExpectedMotion(MOVED @ se3.exp(np.array([metres, 0.0, 0.0, 0.0, 0.0, 0.0])), np.zeros(6), SECONDS)
    assert (not solver.solve(few, expected, np.eye(4), before=len(few)).reason) == found


@pytest.mark.parametrize("mapped", [False, True])
def test_an_unusual_motion_that_the_map_confirms_is_better_than_no_pose(mapped: bool) -> None:
    """A hand-held camera that accelerates a moment after something moved."""
    tracks, on_person = scene(np.random.default_rng(3))
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED, np.zeros(6), SECONDS)
    solver.learn(tracks, solver.solve(tracks, expected, np.eye(4), before=400), expected)
    assert solver.alert
    store = tracks.keep(~on_person)
    store.mapped = np.full(len(store), mapped)
    jump = ExpectedMotion(MOVED @ se3.exp(np.array([0.09, 0, 0, 0, 0, 0])), np.zeros(6), SECONDS)
    static = np.ones(len(store), bool)
    best = solver._solve_all(store, jump, np.eye(4), static)  # pyright: ignore[reportPrivateUsage]
    assert solver._confirmed(best, store.mapped, 30) == mapped  # pyright: ignore[reportPrivateUsage]
    if mapped:
        solution = solver.solve(store, jump, np.eye(4), before=len(store))
        assert off(solution.pose) < 0.005 and not solution.moving.any() and solution.inlier.mean() > 0.9


def test_points_that_a_map_update_moves_together_are_not_lost() -> None:
    """Something moved a moment ago; then the map moves by 5 cm, which no robot does in a frame."""
    tracks, on_person = scene(np.random.default_rng(4))
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED, np.zeros(6), SECONDS)
    store = tracks.keep(~on_person)
    solver.learn(store, solver.solve(store, expected, np.eye(4), before=STILL), expected)
    solver.learn(tracks, solver.solve(tracks, expected, np.eye(4), before=400), expected)
    assert solver.alert
    store.origin, store.mapped = store.origin + np.array([0.05, 0.0, 0.0]), np.ones(STILL, bool)
    solution = solver.solve(store, expected, np.eye(4), before=STILL)
    assert not solution.reason
    assert float(se3.extent(se3.inverse(se3.exp(np.array([0.05, 0, 0, 0, 0, 0])) @ MOVED) @ solution.pose)[0]) < 0.01


def test_a_group_that_disagrees_is_marked_and_tracked_further() -> None:
    tracks, on_person = scene(np.random.default_rng(0))
    for _ in range(3):
        tracks, kept = after_frame(tracks, ~on_person, np.zeros(len(tracks), bool), 3, alert=True, static=STATIC)
        assert kept[~on_person].all()
        on_person = on_person[kept]
    assert on_person.sum() > 0.8 * MOVING
    assert tracks.moving[on_person].all()
    assert not tracks.moving[~on_person].any()
    begun = Movers().near(tracks.uv, tracks.rho, tracks)
    marked = begun > 0
    assert marked[on_person].mean() > 0.9
    assert marked[~on_person].mean() < 0.1
    assert (begun[marked] == STATIC).all()
    assert (Movers().near(tracks.uv, tracks.rho, tracks, 1)[marked] > 0).all()
    assert not Movers().near(tracks.uv, tracks.rho, tracks, 7).any()  # of six neighbours
    for _ in range(STATIC):
        tracks, _ = after_frame(
            tracks, np.ones(len(tracks), bool), np.zeros(len(tracks), bool), 3, alert=True, static=STATIC
        )
    assert not tracks.moving.any()


def test_marks_fade_where_points_mostly_agree() -> None:
    """A still point of a noisy sequence disagrees now and then; new points beside it take over what is left."""
    tracks, on_person = scene(np.random.default_rng(0))
    tracks.moving, tracks.misses = on_person.copy(), np.where(on_person, STATIC, 0).astype(np.int32)
    for frame in range(4 * STATIC):
        agrees = np.full(len(tracks), frame % 5 != 0) | ~tracks.moving
        tracks, _ = after_frame(tracks, agrees, np.zeros(len(tracks), bool), 3, alert=True, static=STATIC)
        begun = Movers().near(tracks.uv, tracks.rho, tracks)
        assert begun.max(initial=0) <= tracks.misses.max()
    assert not tracks.moving.any() and not begun.any()


def test_a_mark_stays_where_points_mostly_disagree() -> None:
    tracks, on_person = scene(np.random.default_rng(0))
    tracks.moving, tracks.misses = on_person.copy(), np.where(on_person, STATIC, 0).astype(np.int32)
    for frame in range(4 * STATIC):
        agrees = np.full(len(tracks), frame % 2 == 0) | ~on_person
        tracks, _ = after_frame(tracks, agrees, np.zeros(len(tracks), bool), 3, alert=True, static=STATIC)
    assert (tracks.moving == on_person).all()


def test_no_point_is_marked_in_a_static_scene() -> None:
    tracks, on_person = scene(np.random.default_rng(0))
    for _ in range(3):
        tracks, _ = after_frame(
            tracks, ~on_person[: len(tracks)], np.zeros(len(tracks), bool), 3, alert=False, static=STATIC
        )
    assert len(tracks) == STILL
    assert not tracks.moving.any()


def test_new_points_where_a_nearer_object_lost_its_points_are_suspect_for_a_second() -> None:
    """Who walks towards the camera: no point on him is tracked for long, and he is nearer in every image."""
    tracks, on_person = scene(np.random.default_rng(0))
    tracks.moving, tracks.misses = on_person.copy(), np.where(on_person, STATIC, 0).astype(np.int32)
    tracks.disagreed = on_person.copy()
    movers = Movers()
    store = tracks.keep(~on_person)
    movers.update(tracks, store, RIG.left, MOVED)
    near, far = (movers.near(tracks.uv[on_person], factor * tracks.rho[on_person], store) for factor in (2.0, 0.5))
    assert near.mean() > 0.9
    assert far.mean() < 0.1
    assert movers.near(store.uv, store.rho, store).mean() < 0.1
    for _ in range(STATIC):
        movers.update(store, store, RIG.left, MOVED)
    assert not movers.near(tracks.uv[on_person], tracks.rho[on_person], store).any()


def test_points_that_were_only_suspect_do_not_make_others_suspect() -> None:
    """Marks would spread over a still room in which a camera that turns finds new points all the time."""
    tracks, on_person = scene(np.random.default_rng(0))
    tracks.moving, tracks.misses = on_person.copy(), np.where(on_person, STATIC, 0).astype(np.int32)
    tracks.disagreed = np.zeros(len(tracks), bool)
    movers = Movers()
    assert not movers.near(tracks.uv, tracks.rho, tracks).any()
    movers.update(tracks, tracks.keep(~on_person), RIG.left, MOVED)
    assert not movers.near(tracks.uv[on_person], tracks.rho[on_person], tracks.keep(~on_person)).any()
    tracks, _ = after_frame(tracks, ~on_person, np.zeros(len(tracks), bool), 3, alert=True, static=STATIC)
    assert (movers.near(tracks.uv, tracks.rho, tracks) > 0)[on_person].mean() > 0.9


def test_the_place_where_something_moved_stays_where_it_is_in_the_room() -> None:
    tracks, on_person = scene(np.random.default_rng(0))
    tracks.moving, tracks.misses = on_person.copy(), np.where(on_person, STATIC, 0).astype(np.int32)
    tracks.disagreed = on_person.copy()
    movers, store = Movers(), tracks.keep(~on_person)
    movers.update(tracks, store, RIG.left, MOVED)
    turned = MOVED @ se3.exp(np.array([0, 0, 0, 0, 0.2, 0]))
    movers.update(store, store, RIG.left, turned)
    uv = RIG.left.project(se3.transform(se3.inverse(turned), tracks.keep(on_person).points()))
    store.uv = RIG.left.project(se3.transform(se3.inverse(turned), store.points()))
    seen = np.isfinite(uv).all(1)
    assert movers.near(uv[seen], tracks.rho[on_person][seen], store.keep(np.isfinite(store.uv).all(1))).mean() > 0.9


def test_an_alert_lasts_while_a_group_disagrees() -> None:
    """Points on a near object are new in every image: none is followed for long enough to be marked."""
    tracks, on_person = scene(np.random.default_rng(1))
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED, np.zeros(6), SECONDS)
    disagree = solver.solve(tracks, expected, np.eye(4), before=400)
    solver.learn(tracks, disagree, expected)
    disagree.moving = np.zeros(len(tracks), bool)
    for _ in range(30):
        solver.learn(tracks, disagree, expected)
    assert solver.alert
    store = tracks.keep(~on_person)
    for _ in range(30):
        solver.learn(store, solver.solve(store, expected, np.eye(4), before=STILL), expected)
    assert not solver.alert


@pytest.mark.parametrize("surely_static", [True, False])
def test_little_of_an_open_view_is_enough_while_what_was_known_before_agrees(surely_static: bool) -> None:
    tracks, on_person = scene(np.random.default_rng(2))
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED, se3.log(MOVED), SECONDS)
    solver.learn(tracks, solver.solve(tracks, expected, np.eye(4), before=400), expected)
    assert solver.alert
    solver.open_view = 200.0
    left = tracks.keep(~on_person & (np.arange(len(tracks)) < 25))
    left.age[:] = 20 if surely_static else 1
    assert (not solver.solve(left, expected, np.eye(4), before=len(left)).reason) == surely_static


def test_of_two_results_for_an_image_the_expected_one_is_taken_while_objects_move() -> None:
    tracks, on_person = scene(np.random.default_rng(0))
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED, se3.log(MOVED), SECONDS)
    camera = solver.solve(tracks, expected, np.eye(4), before=400)
    person = solver.solve_again(tracks.keep(on_person), ExpectedMotion(np.eye(4), np.zeros(6), SECONDS))
    results = [(tracks, camera), (tracks.keep(on_person), person)]
    assert person.inliers > camera.inliers
    assert solver.better(results, expected)[1] is person
    solver.learn(tracks, camera, expected)
    assert solver.better(results, expected)[1] is camera


def test_a_new_point_on_somebody_near_does_not_take_a_known_pose_along() -> None:
    """Sixty points of a wall have it to 4 mm; the new one at 0.7 m takes it along by 10 mm, and is no outlier there."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        before = rng.uniform([-1.2, -0.9, 2.4], [1.2, 0.9, 3.0], (61, 3))
        before[-1] = [-0.3, -0.2, 0.7]
        now = se3.transform(se3.inverse(MOVED), before)
        now[-1, 0] += 0.008
        tracks = scene(rng)[0].keep(np.arange(STILL + MOVING) < 61)
        put(rng, tracks, before, now, 0.25)
        tracks.variance, tracks.age = np.square(0.005 * tracks.rho), np.where(tracks.rho > 1, 1, 20).astype(np.int32)
        solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
        expected = ExpectedMotion(MOVED, se3.log(MOVED), SECONDS)
        all_points = solver._optimise(tracks, expected, np.ones(61, bool))  # pyright: ignore[reportPrivateUsage]
        solution = solver.solve(tracks, expected, np.eye(4), before=61)
        assert all_points.inlier[-1] and off(all_points.pose) > 0.008
        assert off(solution.pose) < 0.006
