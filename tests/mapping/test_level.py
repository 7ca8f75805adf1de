"""Gravity in bundle adjustment, in the pose graph and in saved maps: roll and pitch do not drift, heading may."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereo_sfm.config import LoopConfig, MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.bundle import BundleConfig, bundle_adjust
from stereo_sfm.mapping.correction import apply_loop
from stereo_sfm.mapping.level import Level, level_of, mean_down
from stereo_sfm.mapping.map import Map
from stereo_sfm.mapping.mapper import Mapper
from stereo_sfm.types import F64, LoopResult
from tests.loop.store_sequence import make_sequence
from tests.mapping.test_bundle import bundle_of
from tests.mapping.test_correction import raw_map, true_loop
from tests.synthetic import make_scene, pinhole_rig

DOWN = se3.so3_exp(np.array([0.1, 0.0, -0.05])) @ np.array([0.0, 1.0, 0.0])


def tilt_deg(poses: F64, truth: F64, down: F64 = DOWN) -> F64:
    """(K,) degrees by which each pose is tilted against the truth: the angle between where both see gravity."""
    seen, true = (np.einsum("nji,j->ni", p[:, :3, :3], down) for p in (poses, truth))
    return np.degrees(np.linalg.norm(np.cross(seen, true), axis=1))


def measured(poses: F64, sigma: float, seed: int = 0) -> F64:
    """(K, 3) what cameras (K, 4, 4) see of gravity."""
    noise = np.random.default_rng(seed).normal(0, sigma, (len(poses), 3))
    seen = np.einsum("nji,j->ni", poses[:, :3, :3], DOWN) + noise
    return seen / np.linalg.norm(seen, axis=1, keepdims=True)


def test_derivatives_of_the_gravity_factor() -> None:
    rng = np.random.default_rng(0)
    rot = np.asarray(se3.so3_exp(rng.normal(0, 1, (4, 3))))
    seen = measured(se3.from_rotation_translation(rot, np.zeros((4, 3))), 0.01)
    moving, weight = np.arange(4), np.full(4, 1e3)
    level = Level(seen, weight, np.zeros(4, np.int64), 1e9 * DOWN[None])  # a mean that does not follow

    def cost(phi: F64) -> float:
        return level.evaluate(rot @ se3.so3_exp(phi.reshape(4, 3)), moving)[2]

    h, b = np.zeros((4, 6, 6)), np.zeros((4, 6))
    expected, loss, _ = level.evaluate(rot, moving)
    level.add(expected, loss, seen, h, b)
    step = 1e-5 * np.eye(12)
    gradient = np.array([(cost(d) - cost(-d)) / 2e-5 for d in step])
    np.testing.assert_allclose(-b[:, 3:].ravel(), gradient, atol=1e-5)
    for k in range(4):
        along = (cost(step[3 * k]) - 2 * cost(np.zeros(12)) + cost(-step[3 * k])) / 1e-10
        assert h[k, 3, 3] == pytest.approx(along, rel=0.02)


def test_a_window_is_held_level_and_its_heading_is_not() -> None:
    """Points drift with the fixed keyframe's tilt: gravity brings roll and pitch back, and nothing else."""
    rig = pinhole_rig()
    scene = make_scene(rig, 8, 200, noise_px=0.5, seed=3)
    bundle = bundle_of(scene)
    free = dataclasses.replace(bundle, fixed=np.zeros(8, bool))  # nothing but gravity says what is level
    turned = se3.exp(np.array([0.0, 0.0, 0.0, 0.02, 0.0, 0.015]))
    free = dataclasses.replace(free, world_T_kf=turned @ free.world_T_kf, points=se3.transform(turned, free.points))
    level = Level(measured(scene.world_T_kf, 1e-4), np.full(8, 1e8), np.zeros(8, np.int64), 1e12 * DOWN[None])
    config = BundleConfig(rounds=1, iterations=60, tolerance=1e-12)
    without, held = bundle_adjust(rig, free, config), bundle_adjust(rig, dataclasses.replace(free, level=level), config)
    assert tilt_deg(without.world_T_kf, scene.world_T_kf).min() > 0.5
    assert tilt_deg(held.world_T_kf, scene.world_T_kf).max() < 0.02


def drifting_map(tilt: float, known: bool) -> tuple[Map, F64, LoopResult]:
    """A lap through a store whose odometry tilts by so many radians a keyframe; its truth, and a loop at its end."""
    sequence = make_sequence([0, 0], seed=11)
    truth = se3.inverse(sequence.world_T_kf[0]) @ sequence.world_T_kf
    poses = [truth[0]]
    for step in se3.inverse(truth[:-1]) @ truth[1:]:
        poses.append(poses[-1] @ step @ se3.exp(np.array([0, 0, 0, tilt, 0.3 * tilt, 0])))
    seen = measured(truth, 1e-3)
    sequence = dataclasses.replace(
        sequence,
        keyframes=[
            dataclasses.replace(k, odom_T_cam=pose, down=down if known else np.zeros(3), down_sigma=1e-3 * known)
            for k, pose, down in zip(sequence.keyframes, poses, seen, strict=True)
        ],
    )
    b = len(truth) - 1
    a = int(np.linalg.norm(truth[:30, :3, 3] - truth[b, :3, 3], axis=1).argmin())
    return raw_map(sequence), truth, true_loop(sequence, a, b)


@pytest.mark.parametrize("robust", ["gnc", "switchable"])
def test_a_loop_is_closed_with_four_degrees_of_freedom(robust: str) -> None:
    errors = {}
    for known in (False, True):
        map_, truth, loop = drifting_map(3e-4, known)
        before = tilt_deg(map_.keyframes.map_T_kf, truth)
        assert apply_loop(map_, loop, [], LoopConfig(robust=robust)).applied
        np.testing.assert_allclose(map_.keyframes.map_T_kf[0], truth[0], atol=1e-6)
        errors[known] = tilt_deg(map_.keyframes.map_T_kf, truth)
        assert before.max() > 0.8
    assert errors[True].max() < 0.25 and errors[True].max() < 0.5 * errors[False].max()


def test_direction_of_gravity_in_the_map() -> None:
    map_, _, _ = drifting_map(0.0, True)
    rows = map_.living_keyframes()
    table, nothing = map_.keyframes, drifting_map(0.0, False)[0]
    found = mean_down(table.map_T_kf[rows], table.down[rows], table.down_sigma[rows])
    assert np.degrees(np.linalg.norm(np.cross(found, DOWN))) < 0.02
    table = nothing.keyframes
    assert not mean_down(table.map_T_kf[rows], table.down[rows], table.down_sigma[rows]).any()
    assert level_of(nothing, rows, np.zeros(len(rows), bool)) is None
    part = level_of(map_, rows, rows > 5)
    assert part is not None
    np.testing.assert_allclose(part.rest[0] / np.linalg.norm(part.rest[0]), DOWN, atol=1e-3)


def test_the_mapper_says_where_down_is_and_keeps_without_gravity_what_it_did() -> None:
    sequence = make_sequence([0], seed=2)
    truth = se3.inverse(sequence.world_T_kf[0]) @ sequence.world_T_kf
    mapper, level = Mapper(MapperConfig(), sequence.rig), Mapper(MapperConfig(), sequence.rig)
    for k, down in zip(sequence.keyframes[:12], measured(truth, 1e-4), strict=False):
        plain, held = mapper.step(k), level.step(dataclasses.replace(k, down=down, down_sigma=1e-3))
        assert not plain.down.any()
    assert np.degrees(np.linalg.norm(np.cross(held.down, DOWN))) < 0.05
    off = tilt_deg(level.map.keyframes.map_T_kf, truth[:12])
    assert off.max() < 0.1 and (mapper.map.keyframes.map_T_kf != level.map.keyframes.map_T_kf).any()


def test_gravity_that_the_first_submap_did_not_feel_is_known() -> None:
    """Tracking was lost in the first seconds, before the accelerometer was trusted."""
    sequence = make_sequence([0], seed=2)
    truth = se3.inverse(sequence.world_T_kf[0]) @ sequence.world_T_kf
    mapper = Mapper(MapperConfig(), sequence.rig)
    for k, down in zip(sequence.keyframes[:8], measured(truth, 1e-4), strict=False):
        felt = {"down": down, "down_sigma": 1e-3, "submap_id": 1} if k.kf_id > 2 else {}
        ids = k.point_ids + 10**6 * bool(felt)
        update = mapper.step(dataclasses.replace(k, **felt, point_ids=ids))
    assert np.degrees(np.linalg.norm(np.cross(update.down, DOWN))) < 0.2
