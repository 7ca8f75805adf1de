"""Self-calibration: exact keyframes with noise, true and faulty rigs, steps, and the correction of the map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calibration.row_errors import RowMonitor
from stereo_sfm.calibration.self_calibration import KEYFRAMES, MIN_WINDOWS, Revision, SelfCalibration
from stereo_sfm.config import Config, MapperConfig, SelfCalibrationConfig
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.mapper import Mapper
from stereo_sfm.types import F64, RIG_TERMS, Keyframe
from tests.synthetic import camera_path, fisheye_rig, pinhole_rig, points_around, turned

RIGS = {"fisheye": fisheye_rig(), "pinhole": pinhole_rig()}
NOISE_PX = 0.15


def keyframes(rigs: list[Rig], believed: Rig, seed: int, noise_px: float = NOISE_PX) -> Iterator[Keyframe]:
    """Keyframes of a tracker with the calibration `believed`; keyframe k is observed with rigs[k].

    Odometry is off by a few millimetres a step, as if it had drifted.
    """
    rng = np.random.default_rng(seed)
    path = camera_path(len(rigs))
    points = points_around(path, 60 * len(rigs), rng)
    for k, (rig, pose) in enumerate(zip(rigs, path, strict=True)):
        assert rig.right is not None
        in_left = se3.transform(se3.inverse(pose), points)
        near = np.flatnonzero((in_left[:, 2] > 0.3) & (np.linalg.norm(in_left, axis=1) < 8))
        uv_left = rig.left.project(in_left[near])
        uv_right = rig.project_right(in_left[near])
        seen = rig.left.inside(uv_left) & rig.right.inside(uv_right)
        seen &= np.cumsum(seen) <= 200
        ids, uv_left, uv_right = near[seen], uv_left[seen], uv_right[seen]
        uv_left = uv_left + noise_px * rng.standard_normal(uv_left.shape)
        uv_right = uv_right + noise_px * rng.standard_normal(uv_right.shape)
        guess = pose @ se3.exp(0.003 * rng.standard_normal(6))
        empty = np.zeros((len(ids), 32), np.uint8)
        yield Keyframe(k, 5 * k, 10**9 // 3 * k, guess, ids, uv_left, uv_right, in_left[near][seen], empty)


def revisions(
    true: Rig | list[Rig], believed: Rig, seed: int, count: int = 24
) -> tuple[SelfCalibration, list[Revision]]:
    estimator = SelfCalibration(believed)
    rigs = true if isinstance(true, list) else [true] * count
    found = [estimator.add(k) for k in keyframes(rigs, believed, seed)] + [estimator.finish()]
    return estimator, [r for r in found if r is not None]


@pytest.mark.parametrize("name", RIGS)
def test_a_true_rig_stays(name: str) -> None:
    for seed in range(10):
        assert not revisions(RIGS[name], RIGS[name], seed)[1]


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("degrees", [(0.05, 0, 0), (0, 0.1, 0), (0, -0.3, 0), (0, 0, 0.2), (0.1, -0.1, 0.1)])
def test_a_turned_camera_is_found(name: str, degrees: tuple[float, float, float]) -> None:
    true = RIGS[name]
    wrong = turned(true, degrees)
    estimator, found = revisions(true, wrong, 0, count=48)
    assert found and found[0].since_kf_id == 0
    mended = with_terms(wrong, np.where(np.arange(RIG_TERMS) < 6, estimator.terms, 0.0))  # without its decentering
    left = np.rad2deg(se3.log(se3.inverse(mended.left_T_right) @ true.left_T_right)[3:])
    assert np.abs(left[[0, 2]]).max() < 0.012 and abs(left[1]) < 0.015


@pytest.mark.parametrize("name", RIGS)
def test_the_more_significant_the_sooner(name: str) -> None:
    """0.3 degrees about x before a window, 0.05 later, 0.1 degrees about y (less exact) not before that."""
    true = RIGS[name]
    windows: list[int] = []
    for degrees in ((0.3, 0.0, 0.0), (0.05, 0.0, 0.0), (0.0, 0.1, 0.0)):
        believed = turned(true, degrees)
        estimator = SelfCalibration(believed)
        next(k for k in keyframes([true] * 64, believed, 0) if estimator.add(k) is not None)
        windows.append(len(estimator.windows))
    assert windows[0] == 0 and MIN_WINDOWS <= windows[1] <= windows[2]


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("degrees", [(0.3, 0.0, 0.0), (0.0, 0.0, -0.3), (0.2, 0.0, 0.3)])
def test_a_large_error_is_corrected_with_the_second_keyframe(name: str, degrees: tuple[float, float, float]) -> None:
    """The second with motion, before there is a window."""
    true = RIGS[name]
    believed = turned(true, degrees)
    estimator = SelfCalibration(believed)
    first = next(r for k in keyframes([true] * 8, believed, 0) if (r := estimator.add(k)) is not None)
    assert first.since_kf_id == 0 and first.why == "significant" and not estimator.windows
    mended = with_terms(believed, first.terms)
    left = np.rad2deg(se3.log(se3.inverse(mended.left_T_right) @ true.left_T_right)[3:])
    assert np.abs(left).max() < 0.02


@pytest.mark.parametrize("kind", [6, 7])
def test_a_decentered_lens_is_found(kind: int) -> None:
    """1 px in the corners, as in KITTI's rectified images; the rotations stay within their errors."""
    believed = RIGS["pinhole"]
    terms = np.zeros(RIG_TERMS)
    terms[kind] = 0.004
    estimator, found = revisions(with_terms(believed, terms), believed, 0, count=64)
    assert found and estimator.terms[kind] == pytest.approx(0.004, abs=0.0018)  # three sigmas
    assert np.abs(np.rad2deg(estimator.terms[:3])).max() < 0.015


def test_a_pair_one_above_the_other_is_corrected_alike() -> None:
    """The same keyframes, with images turned by a quarter: the terms of the right camera are turned, too."""
    believed, terms = RIGS["pinhole"], np.zeros(RIG_TERMS)
    terms[:3], terms[6] = np.deg2rad([-0.02, 0.05, -0.04]), 0.006
    true = with_terms(believed, terms)
    assert believed.right is not None
    quarter = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    left, right = (
        replace(c, width=c.height, height=c.width, fx=c.fy, fy=c.fx, cx=c.height - 1 - c.cy, cy=c.cx)
        for c in (believed.left, believed.right)
    )
    above = replace(believed, left=left, right=right, left_T_right=quarter @ believed.left_T_right @ quarter.T)
    estimator, estimator_above = SelfCalibration(believed), SelfCalibration(above)
    found: list[tuple[Revision | None, Revision | None]] = []
    for k in keyframes([true] * 64, believed, 0):
        uv_left, uv_right = (np.stack([left.width - 1 - uv[:, 1], uv[:, 0]], 1) for uv in (k.uv_left, k.uv_right))
        pose = k.odom_T_cam @ quarter.T
        k_above = replace(k, odom_T_cam=pose, uv_left=uv_left, uv_right=uv_right)
        found.append((estimator.add(k), estimator_above.add(k_above)))
    assert any(a for a, _ in found) and all((a is None) == (b is None) for a, b in found)
    terms, above_terms = estimator.terms, estimator_above.terms
    assert np.abs(terms[[0, 1, 2, 6]]).min() > 0
    np.testing.assert_allclose(above_terms[:3], quarter[:3, :3] @ terms[:3], atol=1e-6)
    np.testing.assert_allclose(above_terms[3:], [*terms[3:6], terms[7], -terms[6]], atol=1e-6)


@pytest.mark.parametrize("name", RIGS)
def test_points_tracked_with_a_wrong_rig_are_forgotten(name: str) -> None:
    """They agree with it by a twentieth of its error, and so would the correction."""
    true = RIGS[name]
    wrong, misled = turned(true, (0.0, 0.2, 0.0)), turned(true, (0.0, 0.01, 0.0))
    estimator = SelfCalibration(wrong)
    tracked = [*([misled] * 12), *([true] * 60)]
    found = [r for k in keyframes(tracked, wrong, 1, noise_px=0.03) if (r := estimator.add(k)) is not None]
    assert found and found[0].why == "significant"
    assert min(w.first_kf_id for w in estimator.windows) > 0
    last = estimator.finish()
    assert last is not None and last.why == "refined"
    assert np.rad2deg(abs(last.terms[1] + np.deg2rad(0.2))) < 0.003


def test_all_windows_count_at_the_end() -> None:
    """A change that is not worth a bundle adjustment while mapping is made after the last keyframe."""
    true = RIGS["pinhole"]
    estimator, found = revisions(true, turned(true, (0.0, 0.1, 0.0)), 3, count=56)
    left = estimator.estimate(list(estimator.windows)).without(np.arange(RIG_TERMS) == 1)
    assert found[-1].why == "refined"
    assert left.strength[1] < 0.05


def test_lengths_stay_without_evidence_about_them() -> None:
    """Decentering, known from rows, shifts disparities as well; a rotation about y balances it."""
    believed = RIGS["pinhole"]
    terms = np.zeros(RIG_TERMS)
    terms[6] = 0.004
    estimator, found = revisions(with_terms(believed, terms), believed, 0, count=64)
    length = np.mean([w.length for w in estimator.windows], axis=0)
    alone = abs(length[6] * estimator.terms[6])
    assert found and alone > 0.005 and abs(length @ estimator.terms) < 0.4 * alone


def test_a_fisheye_has_no_decentering() -> None:
    estimator, _ = revisions(RIGS["fisheye"], turned(RIGS["fisheye"], (0.1, 0.0, 0.0)), 0)
    assert not estimator.terms[6:].any()


def noticed(
    rigs: list[Rig], true: Rig, seed: int, at: int, turn: F64, noise_px: float = NOISE_PX
) -> Iterator[Keyframe]:
    """Keyframes whose tracker has noticed that the right camera has turned before keyframe `at`."""
    for keyframe in keyframes(rigs, true, seed, noise_px):
        turned_by = np.zeros(3) if keyframe.kf_id < at else turn
        yield replace(keyframe, right_turn=turned_by, right_turn_covariance=np.deg2rad(0.01) ** 2 * np.eye(3))


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("degrees", [(0.1, 0.0, 0.0), (0.0, -0.2, 0.0), (0.1, -0.3, 0.0)])
def test_a_noticed_rotation_that_no_keyframe_shows_is_no_step(name: str, degrees: tuple[float, float, float]) -> None:
    true, turn = RIGS[name], np.deg2rad(degrees)
    estimator = SelfCalibration(true)
    found = [r for k in noticed([true] * 48, true, 0, 20, turn) if (r := estimator.add(k)) is not None]
    assert not [r for r in found if r.why == "step"]
    assert np.abs(np.rad2deg(estimator.terms[:3])).max() < 0.02 and estimator.windows[-1].first_kf_id > 30


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("degrees", [(0.0, 0.1, 0.0), (0.0, -0.2, 0.0), (0.0, 0.0, 0.4)])
def test_a_noticed_rotation_is_a_step_once_it_has_stayed(name: str, degrees: tuple[float, float, float]) -> None:
    true = RIGS[name]
    rigs = [true] * 12 + [turned(true, degrees)] * KEYFRAMES
    estimator = SelfCalibration(true)
    *before, step = [estimator.add(k) for k in noticed(rigs, true, 0, 12, np.deg2rad(degrees))]
    assert not any(before) and step is not None and (step.why, step.since_kf_id) == ("step", 12)
    assert np.rad2deg(step.terms[:3]) == pytest.approx(degrees)


def test_a_rotation_that_did_not_stay_is_none() -> None:
    true = RIGS["pinhole"]
    estimator = SelfCalibration(true)
    for k in noticed([true] * 40, true, 0, 12, np.deg2rad([0.0, 0.2, 0.0])):
        back = k.kf_id >= 12 + KEYFRAMES - 1
        assert estimator.add(replace(k, right_turn=np.zeros(3)) if back else k) is None


def test_a_step_is_refined_by_what_was_known_before_it_and_what_comes_after() -> None:
    """The rig was wrong by 0.1 degrees before, and the tracker measures a step of 0.2 as 0.19."""
    true = RIGS["pinhole"]
    rigs = [turned(true, (0.0, 0.1, 0.0))] * 40 + [turned(true, (0.0, 0.3, 0.0))] * 40
    estimator = SelfCalibration(true)
    found = [estimator.add(k) for k in noticed(rigs, true, 1, 40, np.deg2rad([0.0, 0.19, 0.0]))]
    assert [r.why for r in found if r is not None].count("step") == 1
    assert np.rad2deg(estimator.terms[1]) == pytest.approx(0.3, abs=0.02)


def test_the_map_is_right_before_and_after_a_step() -> None:
    true = RIGS["pinhole"]
    rigs = [true] * 40 + [turned(true, (0.0, 0.2, 0.0))] * 64
    mapper = Mapper(MapperConfig(association="tracks"), true, calibration=SelfCalibration(true))
    for keyframe in noticed(rigs, true, 1, 40, np.deg2rad([0.0, 0.2, 0.0]), noise_px=0.05):
        mapper.step(keyframe)
    mapper.finish([])
    at, path = mapper.map.keyframes.map_T_kf[:, :3, 3], camera_path(len(rigs))[:, :3, 3]
    for part in (slice(0, 40), slice(40, None)):
        length, true_length = (np.linalg.norm(np.diff(x[part], axis=0), axis=1).sum() for x in (at, path))
        assert length / true_length == pytest.approx(1.0, abs=0.02)


def drifting(name: str, axis: int, count: int = 320) -> tuple[list[Rig], F64]:
    """A rig that turns by 0.1 degrees in 320 keyframes, some two minutes; (K, 3) its turns."""
    turns: F64 = 0.1 / 320 * np.arange(count)[:, None] * np.eye(3)[axis]
    return [turned(RIGS[name], tuple(turn)) for turn in turns], turns


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("name", RIGS)
def test_drift_is_followed(name: str, axis: int) -> None:
    """Also about y, which trades with range: from where the change is beyond the windows' scatter."""
    true = RIGS[name]
    rigs, turns = drifting(name, axis)
    estimator, now = SelfCalibration(true), np.zeros_like(turns)
    for at, keyframe in zip(now, keyframes(rigs, true, 0), strict=True):
        revision = estimator.add(keyframe)
        at[:] = np.rad2deg(estimator.terms[:3])
        if revision is not None and revision.why == "drift":
            assert np.rad2deg(revision.terms[:3]) == pytest.approx(turns[revision.since_kf_id], abs=0.02)
            for kf_id, terms in revision.on_the_way:
                assert np.rad2deg(terms[:3]) == pytest.approx(turns[kf_id], abs=0.02)
    assert np.abs(now - turns)[200:].max() < 0.03


def test_the_map_is_right_during_a_drift() -> None:
    """Also where the drift was not yet known."""
    true, count = RIGS["pinhole"], 176
    mapper = Mapper(MapperConfig(association="tracks"), true, calibration=SelfCalibration(true))
    for keyframe in keyframes(drifting("pinhole", 1, count)[0], true, 0, noise_px=0.05):
        mapper.step(keyframe)
    mapper.finish([])
    rows = mapper.map.living_keyframes()
    steps, true_steps = (
        np.linalg.norm(np.diff(poses[rows, :3, 3], axis=0), axis=1)
        for poses in (mapper.map.keyframes.map_T_kf, camera_path(count))
    )
    for part in np.array_split(np.arange(len(steps)), 3):
        assert steps[part].sum() / true_steps[part].sum() == pytest.approx(1.0, abs=0.007)


@pytest.mark.parametrize("name", RIGS)
def test_a_true_rig_stays_for_long(name: str) -> None:
    assert not revisions(RIGS[name], RIGS[name], 0, count=320)[1]


def test_the_same_keyframes_give_the_same_bits() -> None:
    wrong = turned(RIGS["fisheye"], (0.0, 0.1, 0.0))
    a, b = (revisions(RIGS["fisheye"], wrong, 3, count=48)[0].terms for _ in range(2))
    assert a.any() and np.array_equal(a, b)


@pytest.mark.parametrize("mode", ["auto", "off", "only-report"])
def test_which_runs_are_corrected(mode: str) -> None:
    config = replace(Config(), self_calibration=SelfCalibrationConfig(mode))
    stereo, mono = RIGS["pinhole"], Rig(RIGS["pinhole"].left)
    assert (SelfCalibration.from_config(config, stereo) is None) == (mode == "off")
    assert SelfCalibration.from_config(config, mono) is None
    assert SelfCalibration.from_config(config, replace(stereo, depth=True)) is None


@pytest.mark.parametrize("degrees", [(0.2, 0.0, 0.0), (0.0, 0.0, 0.2)])
def test_the_monitor_measures_row_errors(degrees: tuple[float, float, float]) -> None:
    """A rotation about x shifts all rows by focal length times angle; one about z tilts them."""
    true = RIGS["pinhole"]
    monitor = RowMonitor(turned(true, degrees))
    seen = [monitor.add(k) for k in keyframes([true] * 6 + [true] * 6, true, 0)]
    regions = seen[-1].region_px.reshape(3, 4)
    angle = np.deg2rad(0.2)
    if degrees[0]:
        np.testing.assert_allclose(np.abs(regions[1]), true.left.fx * angle, rtol=0.15)
        assert seen[-1].warning
    else:
        assert np.sign(regions[1, 0]) == -np.sign(regions[1, -1]) and np.abs(regions[1, [0, -1]]).min() > 0.4
    monitor.use(true)
    assert monitor.add(next(keyframes([true], true, 1))).systematic_px < 0.15


@pytest.mark.parametrize("mode", [True, False])
def test_the_map_is_corrected_with_the_rig(mode: bool) -> None:
    """0.2 degrees about y change the length of the path by several per cent; corrected, it is right."""
    true = RIGS["pinhole"]
    wrong = turned(true, (0.0, 0.2, 0.0))
    mapper = Mapper(MapperConfig(association="tracks"), wrong, calibration=SelfCalibration(wrong, mode))
    updates = [mapper.step(k) for k in keyframes([true] * 24, wrong, 0)]
    last = mapper.finish([])
    told = [u.calibration for u in [*updates, last] if u is not None and u.calibration is not None]
    assert told and all(c.applied == mode for c in told)
    ends = mapper.map.keyframes.map_T_kf[[0, -1], :3, 3]
    path = camera_path(24)[[0, -1], :3, 3]
    ratio = np.linalg.norm(ends[1] - ends[0]) / np.linalg.norm(path[1] - path[0])
    assert (abs(ratio - 1) < 0.01) == mode


def test_a_small_map_is_right_with_the_update_that_corrects_the_rig() -> None:
    """The tracker must not solve for poses with points of the corrected rig at keyframes of the wrong one."""
    true = RIGS["pinhole"]
    wrong = turned(true, (0.0, -0.3, 0.0))
    mapper = Mapper(MapperConfig(association="tracks"), wrong, calibration=SelfCalibration(wrong))
    frames = keyframes([true] * 24, wrong, 0)
    count = 1 + next(n for n, k in enumerate(frames) if mapper.step(k).calibration is not None)
    at = mapper.map.keyframes.map_T_kf[:count, :3, 3]
    steps = np.linalg.norm(np.diff(at, axis=0), axis=1)
    true_steps = np.linalg.norm(np.diff(camera_path(24)[:count, :3, 3], axis=0), axis=1)
    assert steps.sum() / true_steps.sum() == pytest.approx(1.0, abs=0.015)
