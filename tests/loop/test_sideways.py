"""Loops across directions of travel, on keyframes up and down aisles with exact truth.

Only the views that face the shelves look alike in both directions: of other corners there are none, and tracked points
look different on the way back.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereo_sfm.config import LoopConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop.closer import LoopCloser
from stereo_sfm.loop.sideways import Fronts, front_of, with_neighbours
from stereo_sfm.loop.vocabulary_file import default_vocabulary
from stereo_sfm.types import F64, I64, U8, Corners, Keyframe, LoopResult
from tests.synthetic import fisheye_rig, see

PITCH, LENGTH, POINTS = 3.0, 10.0, 1500
RIG = fisheye_rig()


def shelves(aisles: int, copies: bool, rng: np.random.Generator) -> tuple[F64, U8]:
    """Points (P, 3) on both sides of aisles along z, and their looks (P, 32), in each aisle the same if `copies`."""
    side = np.where(rng.random(POINTS) < 0.5, -1.1, 1.1)
    one = np.stack([side, rng.uniform(-1, 1, POINTS), rng.uniform(0, LENGTH, POINTS)], 1)
    points = np.concatenate([one + np.array([PITCH * k, 0, 0]) for k in range(aisles)])
    looks = rng.integers(0, 256, (len(points), 32)).astype(np.uint8)
    return points, np.tile(looks[:POINTS], (aisles, 1)) if copies else looks


def path(back_in: int) -> F64:
    """(K, 4, 4) up the first aisle, round its end on the outside, and down the aisle `back_in`."""
    up = np.arange(0.0, LENGTH - 1, 0.4)
    x = np.concatenate([0 * up, np.linspace(0, PITCH * back_in, 13), 0 * up + PITCH * back_in + 0.1])
    z = np.concatenate([up, LENGTH + 3 * np.sin(np.linspace(0, np.pi, 13)), up[::-1]])
    yaw = np.concatenate([0 * up, np.linspace(0, np.pi, 13), 0 * up + np.pi])
    turns = se3.so3_exp(np.stack([0 * yaw, yaw, 0 * yaw], 1))
    return se3.from_rotation_translation(turns, np.stack([x, 0 * x, z], 1))


def corners_of(pose: F64, points: F64, looks: U8, rng: np.random.Generator) -> tuple[I64, Corners]:
    """Rows of the points that both cameras see beside them, with noise in pixels, depths and bits."""
    seen, left, right = see(RIG, pose, points, max_depth=2.5)
    cam = se3.transform(se3.inverse(pose), points)
    rows = np.flatnonzero(seen & np.isfinite(right[:, 0]) & (np.abs(cam[:, 0]) < 1.5))
    left, right = (uv[rows] + rng.normal(0, 0.4, (len(rows), 2)) for uv in (left, right))
    depth = 1 + 0.4 * RIG.range_sigmas(cam[rows], 1.0) / np.linalg.norm(cam[rows], axis=1) * rng.normal(size=len(rows))
    flips = np.packbits(rng.random((len(rows), 256)) < 0.06, axis=1)
    columns = (a.astype(np.float32) for a in (left, right, cam[rows] * depth[:, None]))
    return rows, Corners(*columns, looks[rows] ^ flips)


def drive(poses: F64, points: F64, looks: U8, rng: np.random.Generator) -> list[Keyframe]:
    """What a tracker would send, with a little drift."""
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    drift = se3.exp(rng.normal(0, 1, (len(steps), 6)) * np.array([0.002] * 3 + [0.0004] * 3))
    odom = [np.eye(4)]
    for step in steps @ drift:
        odom.append(odom[-1] @ step)
    out: list[Keyframe] = []
    for k, pose in enumerate(poses):
        rows, sides = corners_of(pose, points, looks, rng)
        back = pose[2, 2] < 0
        ids = rows + back * len(points)
        descriptors = rng.integers(0, 256, sides.descriptors.shape).astype(np.uint8)
        uv_left, uv_right, xyz = (a.astype(np.float64) for a in (sides.uv_left, sides.uv_right, sides.points_cam))
        keyframe = Keyframe(k, k, k * 4 * 10**8, odom[k], ids, uv_left, uv_right, xyz, descriptors, sides=sides)
        out.append(keyframe)
    return out


def results(keyframes: list[Keyframe], **options: object) -> list[LoopResult]:
    closer = LoopCloser(dataclasses.replace(LoopConfig(), **options), RIG, default_vocabulary())
    return [closer.step(keyframe) for keyframe in keyframes]


@pytest.mark.parametrize("seed", [0, 1])
def test_the_way_back_is_joined_to_the_way_there(seed: int) -> None:
    rng, poses = np.random.default_rng(seed), path(0)
    points, looks = shelves(1, False, rng)
    loops = [r for r in results(drive(poses, points, looks, rng)) if r.candidate_kf_id >= 0]
    assert loops
    for loop in loops:
        true = se3.inverse(poses[loop.candidate_kf_id]) @ poses[loop.kf_id]
        metres, radians = se3.extent(se3.inverse(true) @ loop.candidate_T_kf)
        assert np.degrees(se3.extent(true)[1]) > 150 and metres < 0.03 and np.degrees(radians) < 1.0


def test_without_such_views_nothing_is_found() -> None:
    rng = np.random.default_rng(0)
    points, looks = shelves(1, False, rng)
    blind = [dataclasses.replace(k, sides=Corners.none()) for k in drive(path(0), points, looks, rng)]
    assert all(r.candidate_kf_id < 0 for r in results(blind))


def test_the_way_down_an_identical_aisle_is_not_joined() -> None:
    rng = np.random.default_rng(0)
    points, looks = shelves(2, True, rng)
    answers = results(drive(path(1), points, looks, rng))
    assert all(r.candidate_kf_id < 0 for r in answers)
    assert "against_odometry" in {why for r in answers for _, _, why in r.rejected}  # it was tempted


def test_the_same_bits_again() -> None:
    rng = np.random.default_rng(3)
    points, looks = shelves(1, False, rng)
    keyframes = drive(path(0), points, looks, rng)
    first, second = results(keyframes), results(keyframes)
    for a, b in zip(first, second, strict=True):
        assert a.rejected == b.rejected and np.array_equal(a.candidate_T_kf, b.candidate_T_kf)


def test_keyframes_without_views_do_not_hide_the_places_between_them() -> None:
    scores = np.array([0.5, 0.0, 0.4, 0.0, 0.0, 0.1])
    assert np.allclose(with_neighbours(scores), [0.9, 0, 1.0, 0, 0, 0.5])


def test_the_keyframe_whose_views_overlap_most_is_the_first() -> None:
    rng, poses = np.random.default_rng(0), path(0)
    points, looks = shelves(1, False, rng)
    keyframes = drive(poses, points, looks, rng)
    fronts = Fronts(RIG.left)
    for keyframe in keyframes:
        fronts.add(keyframe)
    newest = next(k for k in range(len(poses)) if poses[k, 2, 2] < -0.99 and poses[k, 2, 3] < 6)
    rows = fronts.turned(front_of(keyframes[newest]), se3.inverse(poses[newest]) @ poses)
    assert len(rows) and (poses[rows, 2, 2] > 0.5).all()
    back = poses[newest, 2, 3] - poses[rows[0], 2, 3]
    assert 0.4 < back < 2.5  # behind it, as its views show what it approaches and those of the way there too
    unknown = np.full_like(poses, np.nan)
    assert not len(fronts.turned(front_of(keyframes[newest]), unknown))
    none = dataclasses.replace(keyframes[newest], sides=Corners.none())
    assert not len(fronts.turned(front_of(none), se3.inverse(poses[newest]) @ poses))
