"""Moving objects: settled points determine the pose, moving points are marked."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereo_sfm.config import TrackerConfig
from stereo_sfm.drivers.sim.rigs import make_rig
from stereo_sfm.geometry import se3
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
NONE = np.zeros(0, bool)


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
    )
    return tracks, on_person


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
    assert RIG.right is not None
    before: F64 = np.where(on_person[:, None], tracks.points(), [0.0, 0.0, 4.0] + 0.15 * tracks.points())
    now = se3.transform(se3.inverse(MOVED), before + on_person[:, None] * [0.02, 0.0, 0.0])
    distance = np.linalg.norm(before, axis=1)
    tracks.direction, tracks.rho = before / distance[:, None], 1 / distance
    tracks.uv = RIG.left.project(now) + rng.normal(0, 0.2, (len(now), 2))
    tracks.uv_right = RIG.project_right(now) + rng.normal(0, 0.2, (len(now), 2))
    tracks.age[:], tracks.mapped[:] = 60, True
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED @ se3.exp(np.full(6, 0.001)), se3.log(MOVED), SECONDS)
    solution = solver.solve(tracks, expected, np.eye(4), before=len(tracks))
    assert off(solution.pose) < 0.008
    assert solution.moving[on_person].mean() > 0.7
    assert not solution.moving[~on_person].any()


def test_a_smaller_group_that_moves_is_marked_at_once() -> None:
    tracks, on_person = scene(np.random.default_rng(1))
    fewer = np.arange(len(tracks)) < STILL + 50
    tracks, on_person = tracks.keep(fewer), on_person[fewer]
    tracks.age[:] = 0  # nothing has settled: most decide
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
        assert off(solution.pose) < 0.005 and not len(solution.moving) and solution.inlier.mean() > 0.9


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
        tracks, kept = after_frame(tracks, ~on_person, NONE, 3, alert=True, static=STATIC)
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
        tracks, _ = after_frame(tracks, np.ones(len(tracks), bool), NONE, 3, alert=True, static=STATIC)
    assert not tracks.moving.any()


def test_marks_fade_where_points_mostly_agree() -> None:
    """A still point of a noisy sequence disagrees now and then; new points beside it take over what is left."""
    tracks, on_person = scene(np.random.default_rng(0))
    tracks.moving, tracks.misses = on_person.copy(), np.where(on_person, STATIC, 0).astype(np.int32)
    for frame in range(4 * STATIC):
        agrees = np.full(len(tracks), frame % 5 != 0) | ~tracks.moving
        tracks, _ = after_frame(tracks, agrees, NONE, 3, alert=True, static=STATIC)
        begun = Movers().near(tracks.uv, tracks.rho, tracks)
        assert begun.max(initial=0) <= tracks.misses.max()
    assert not tracks.moving.any() and not begun.any()


def test_a_mark_stays_where_points_mostly_disagree() -> None:
    tracks, on_person = scene(np.random.default_rng(0))
    tracks.moving, tracks.misses = on_person.copy(), np.where(on_person, STATIC, 0).astype(np.int32)
    for frame in range(4 * STATIC):
        agrees = np.full(len(tracks), frame % 2 == 0) | ~on_person
        tracks, _ = after_frame(tracks, agrees, NONE, 3, alert=True, static=STATIC)
    assert (tracks.moving == on_person).all()


def test_no_point_is_marked_in_a_static_scene() -> None:
    tracks, on_person = scene(np.random.default_rng(0))
    for _ in range(3):
        tracks, _ = after_frame(tracks, ~on_person[: len(tracks)], NONE, 3, alert=False, static=STATIC)
    assert len(tracks) == STILL
    assert not tracks.moving.any()


def test_new_points_where_a_nearer_object_lost_its_points_are_suspect_for_a_second() -> None:
    """Who walks towards the camera: no point on him is tracked for long, and he is nearer in every image."""
    tracks, on_person = scene(np.random.default_rng(0))
    tracks.moving, tracks.misses = on_person.copy(), np.where(on_person, STATIC, 0).astype(np.int32)
    movers = Movers()
    store = tracks.keep(~on_person)
    movers.update(tracks, store, 0, STATIC)
    near, far = (movers.near(tracks.uv[on_person], factor * tracks.rho[on_person], store) for factor in (2.0, 0.5))
    assert near.mean() > 0.9
    assert far.mean() < 0.1
    assert movers.near(store.uv, store.rho, store).mean() < 0.1
    movers.update(store, store, 1_100_000_000, STATIC)
    assert not movers.near(tracks.uv[on_person], tracks.rho[on_person], store).any()


def test_points_that_were_only_suspect_do_not_make_others_suspect() -> None:
    tracks, on_person = scene(np.random.default_rng(0))
    tracks.moving, tracks.misses = on_person.copy(), np.where(on_person, STATIC, 0).astype(np.int32)
    tracks.age[on_person] = 0
    movers = Movers()
    movers.update(tracks, tracks.keep(~on_person), 0, STATIC)
    assert not movers.near(tracks.uv[on_person], tracks.rho[on_person], tracks.keep(~on_person)).any()


def test_an_alert_lasts_while_a_group_disagrees() -> None:
    """Points on a near object are new in every image: none is followed for long enough to be marked."""
    tracks, on_person = scene(np.random.default_rng(1))
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED, np.zeros(6), SECONDS)
    disagree = solver.solve(tracks, expected, np.eye(4), before=400)
    solver.learn(tracks, disagree, expected)
    disagree.moving = NONE
    for _ in range(30):
        solver.learn(tracks, disagree, expected)
    assert solver.alert
    store = tracks.keep(~on_person)
    for _ in range(30):
        solver.learn(store, solver.solve(store, expected, np.eye(4), before=STILL), expected)
    assert not solver.alert


@pytest.mark.parametrize("settled", [True, False])
def test_little_of_an_open_view_is_enough_while_what_was_known_before_agrees(settled: bool) -> None:
    tracks, on_person = scene(np.random.default_rng(2))
    solver = FramePoseSolver(TrackerConfig(), StereoCameras.of(RIG), RollingShutter(RIG))
    expected = ExpectedMotion(MOVED, se3.log(MOVED), SECONDS)
    solver.learn(tracks, solver.solve(tracks, expected, np.eye(4), before=400), expected)
    assert solver.alert
    solver.open_view = 200.0
    left = tracks.keep(~on_person & (np.arange(len(tracks)) < 25))
    left.age[:] = 20 if settled else 1
    assert (not solver.solve(left, expected, np.eye(4), before=len(left)).reason) == settled


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
