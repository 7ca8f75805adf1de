"""Relocalization in a saved map without a prior, its refusal elsewhere, and a sequence tracked in the map."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereo_sfm.config import LoopConfig, MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop import vocabulary as voc
from stereo_sfm.mapping.keyframe_poses import KeyframePoses
from stereo_sfm.maps.extension import Extension
from stereo_sfm.maps.localizer import Localizer
from stereo_sfm.maps.relocalization import Relocalizer
from stereo_sfm.types import F64, U8, Corners, Keyframe
from tests.loop.store_sequence import StoreSequence, make_sequence
from tests.maps.maps import map_of_sequence


@pytest.fixture(scope="module")
def sequence() -> StoreSequence:
    """Two aisles: the map is of the first pass through both; the second pass through the first aisle is localized."""
    return make_sequence([0, 1, 0], seed=21, max_points=450)


@pytest.fixture(scope="module")
def first_pass(sequence: StoreSequence) -> int:
    return next(
        k
        for k in range(90, len(sequence.keyframes))
        if sequence.world_T_kf[k, 2, 3] < 0 and sequence.world_T_kf[k, 0, 3] < 1
    )


@pytest.fixture(scope="module")
def vocabulary(sequence: StoreSequence) -> voc.Vocabulary:
    return voc.train([k.descriptors for k in sequence.keyframes[:80]], depth=3)


@pytest.fixture(scope="module")
def relocalizer(sequence: StoreSequence, first_pass: int, vocabulary: voc.Vocabulary) -> Relocalizer:
    part = sequence.first(first_pass)
    return Relocalizer(map_of_sequence(part).snapshot, sequence.rig, vocabulary, LoopConfig())


def true_pose(sequence: StoreSequence, k: int) -> F64:
    return se3.inverse(sequence.world_T_kf[0]) @ sequence.world_T_kf[k]


def test_views_of_the_known_aisle_are_found(sequence: StoreSequence, first_pass: int, relocalizer: Relocalizer) -> None:
    errors = []
    asked = range(first_pass + 8, len(sequence.keyframes), 3)
    for k in asked:
        location = relocalizer.locate(sequence.keyframes[k])
        if not location.found:
            continue
        error = se3.inverse(true_pose(sequence, k)) @ location.map_T_cam
        errors.append((np.linalg.norm(error[:3, 3]), np.rad2deg(np.linalg.norm(se3.log(error)[3:]))))
        assert np.linalg.eigvalsh(location.information).min() > 0
    assert len(errors) >= 0.9 * len(asked)
    assert np.max(errors, axis=0)[0] < 0.05 and np.max(errors, axis=0)[1] < 1.0


def test_an_unknown_place_is_not_found(sequence: StoreSequence, relocalizer: Relocalizer) -> None:
    elsewhere = make_sequence([0], seed=77)
    for keyframe in elsewhere.keyframes[2::8]:
        location = relocalizer.locate(keyframe)
        assert not location.found and location.reason


def _exchanged(descriptors: U8, rng: np.random.Generator) -> U8:
    looks: U8 = rng.integers(0, 256, descriptors.shape, dtype=np.uint8)
    return np.where(rng.random((len(descriptors), 1)) < 0.2, looks, descriptors)


def test_a_fifth_of_the_products_exchanged(sequence: StoreSequence, first_pass: int, relocalizer: Relocalizer) -> None:
    rng = np.random.default_rng(0)
    found = 0
    asked = range(first_pass + 8, len(sequence.keyframes), 4)
    for k in asked:
        keyframe = sequence.keyframes[k]
        corners = dataclasses.replace(keyframe.corners, descriptors=_exchanged(keyframe.corners.descriptors, rng))
        changed = dataclasses.replace(keyframe, descriptors=_exchanged(keyframe.descriptors, rng), corners=corners)
        location = relocalizer.locate(changed)
        if location.found:
            found += 1
            assert np.linalg.norm((se3.inverse(true_pose(sequence, k)) @ location.map_T_cam)[:3, 3]) < 0.05
    assert found >= 0.8 * len(asked)


def _half_changed(keyframe: Keyframe) -> Keyframe:
    """A keyframe that recognises less than half of its corners ahead."""
    half = np.random.default_rng(keyframe.kf_id).random((len(keyframe.corners), 1)) < 0.55
    looks = np.where(half, 255 - keyframe.corners.descriptors, keyframe.corners.descriptors)
    return dataclasses.replace(keyframe, corners=dataclasses.replace(keyframe.corners, descriptors=looks))


def test_shelves_beside_contradict_a_view_that_looks_alike(
    sequence: StoreSequence, first_pass: int, vocabulary: voc.Vocabulary
) -> None:
    """Rows of lamps look alike in other places too: what is beside tells them apart, whatever the rest."""
    keyframes = [dataclasses.replace(k, sides=k.corners) for k in sequence.keyframes]
    part = dataclasses.replace(sequence, keyframes=keyframes).first(first_pass)
    relocalizer = Relocalizer(map_of_sequence(part).snapshot, sequence.rig, vocabulary, LoopConfig())
    described = [k for k in range(first_pass + 8, len(keyframes)) if keyframes[k].described]
    other = keyframes[60]  # in the second aisle
    for k in described[::4]:
        unsure = _half_changed(keyframes[k])
        location = relocalizer.locate(unsure)
        assert location.found and not location.confident
        moved = relocalizer.locate(dataclasses.replace(unsure, sides=other.sides))
        assert not moved.found or np.linalg.norm((moved.map_T_cam - location.map_T_cam)[:3, 3]) > 1.0
        assert relocalizer.locate(dataclasses.replace(unsure, sides=Corners.none())).found


def test_what_is_ahead_contradicts_shelves_that_look_alike(
    sequence: StoreSequence, first_pass: int, vocabulary: voc.Vocabulary
) -> None:
    """A place found by the shelves beside, from the same direction, must not have less support than one ahead."""
    keyframes = [dataclasses.replace(k, sides=k.corners) for k in sequence.keyframes]
    part = dataclasses.replace(sequence, keyframes=keyframes).first(first_pass)
    relocalizer = Relocalizer(map_of_sequence(part).snapshot, sequence.rig, vocabulary, LoopConfig())
    k = next(k for k in range(first_pass + 8, len(keyframes)) if keyframes[k].described)
    other = keyframes[60].sides  # in the second aisle
    beside = relocalizer.locate(dataclasses.replace(keyframes[k], corners=Corners.none(), sides=other))
    unsure = dataclasses.replace(_half_changed(keyframes[k]), sides=Corners.none())
    ahead = relocalizer.locate(unsure)
    assert beside.found and ahead.found
    for times, known in ((1.0, False), (2.0, True)):
        sides = _part(other, times * ahead.inliers / beside.inliers)
        assert relocalizer.locate(dataclasses.replace(unsure, corners=Corners.none(), sides=sides)).found
        location = relocalizer.locate(dataclasses.replace(unsure, sides=sides))
        assert abs(location.kf_id - beside.kf_id) < 2 if known else location.reason == "ambiguous"


def _part(corners: Corners, share: float) -> Corners:
    """A share of corners, evenly chosen."""
    rows = np.linspace(0, len(corners) - 1, round(share * len(corners))).astype(int)
    return Corners(*(getattr(corners, f.name)[rows] for f in dataclasses.fields(corners)))


def test_poses_are_refined_by_what_is_beside_too(
    sequence: StoreSequence, first_pass: int, vocabulary: voc.Vocabulary
) -> None:
    """Corners of two sets of random halves: together they say more than those ahead alone."""
    rng = np.random.default_rng(4)
    halves = [
        dataclasses.replace(k, corners=_part(k.corners, 0.5), sides=_part(k.corners, 1.0)) if k.described else k
        for k in sequence.keyframes
    ]
    part = dataclasses.replace(sequence, keyframes=halves).first(first_pass)
    relocalizer = Relocalizer(map_of_sequence(part).snapshot, sequence.rig, vocabulary, LoopConfig())
    alone, together = list[float](), list[float]()
    for k in range(first_pass + 8, len(halves), 2):
        if not halves[k].described:
            continue
        noisy = dataclasses.replace(
            halves[k],
            corners=_shaken(halves[k].corners, rng),
            sides=_shaken(halves[k].sides, rng),
        )
        found = relocalizer.locate(noisy), relocalizer._find(noisy)
        if all(x.found for x in found):
            for errors, place in zip((together, alone), found, strict=True):
                errors.append(float(np.linalg.norm((se3.inverse(true_pose(sequence, k)) @ place.map_T_cam)[:3, 3])))
    assert len(alone) > 5 and np.mean(together) < 0.95 * np.mean(alone)


def _shaken(corners: Corners, rng: np.random.Generator) -> Corners:
    """With half a pixel of noise in both images."""
    left, right = (uv + rng.normal(0, 0.5, uv.shape).astype(np.float32) for uv in (corners.uv_left, corners.uv_right))
    return dataclasses.replace(corners, uv_left=left, uv_right=right)


def test_a_share_of_zero_is_allowed(sequence: StoreSequence, first_pass: int, vocabulary: voc.Vocabulary) -> None:
    part = sequence.first(first_pass)
    config = dataclasses.replace(LoopConfig(), relocalize_share=0.0, min_inlier_share=0.0)
    lenient = Relocalizer(map_of_sequence(part).snapshot, sequence.rig, vocabulary, config)
    keyframe = sequence.keyframes[first_pass + 8]
    place = lenient.locate(keyframe)
    assert place.found and lenient.locate_near(keyframe, place.map_T_cam).found


def test_a_view_without_points_has_a_reason(sequence: StoreSequence, relocalizer: Relocalizer) -> None:
    blind = dataclasses.replace(
        sequence.keyframes[3], descriptors=np.zeros_like(sequence.keyframes[3].descriptors), corners=Corners.none()
    )
    location = relocalizer.locate(blind)
    assert location.reason == "no_candidate"


def test_localizer_places_the_odometry_frame_and_keeps_it(
    sequence: StoreSequence, first_pass: int, vocabulary: voc.Vocabulary
) -> None:
    part = sequence.first(first_pass)
    localizer = Localizer(Relocalizer(map_of_sequence(part).snapshot, sequence.rig, vocabulary, LoopConfig()))
    start = first_pass + 8
    odom = se3.inverse(sequence.keyframes[start].odom_T_cam)
    for n, k in enumerate(range(start, len(sequence.keyframes))):
        keyframe = dataclasses.replace(
            sequence.keyframes[k], kf_id=n, odom_T_cam=odom @ sequence.keyframes[k].odom_T_cam
        )
        update = localizer.step(keyframe)
        assert update.kf_id == n and update.version == n + 1 and len(update.point_ids) == 0
        error = se3.inverse(true_pose(sequence, k)) @ update.map_T_odom @ keyframe.odom_T_cam
        assert localizer.found
        assert np.linalg.norm(error[:3, 3]) < 0.08


def test_localizer_before_it_is_found(sequence: StoreSequence, vocabulary: voc.Vocabulary, first_pass: int) -> None:
    part = sequence.first(first_pass)
    localizer = Localizer(Relocalizer(map_of_sequence(part).snapshot, sequence.rig, vocabulary, LoopConfig()))
    update = localizer.step(make_sequence([0], seed=77).keyframes[4])
    assert not localizer.found
    assert np.array_equal(update.map_T_odom, np.eye(4)) and len(update.kf_ids) == 0  # no place is claimed
    assert localizer.last is not None and localizer.last.reason


def test_gravity_is_that_of_the_saved_map(sequence: StoreSequence, vocabulary: voc.Vocabulary, first_pass: int) -> None:
    part, down = sequence.first(first_pass), np.array([0.6, 0.8, 0.0])
    saved = map_of_sequence(part).snapshot
    seen = np.einsum("nji,j->ni", saved.map_T_kf[:, :3, :3], down)
    level = dataclasses.replace(saved, down=seen, down_sigma=np.full(len(seen), 0.01))
    felt = np.array([0.0, 0.0, 1.0])
    keyframe = dataclasses.replace(sequence.keyframes[first_pass + 8], kf_id=0, down=felt, down_sigma=0.1)
    stranger = dataclasses.replace(make_sequence([0], seed=77).keyframes[4], down=felt, down_sigma=0.1)
    for map_, told in ((level, down), (saved, None)):  # a map without: as the keyframe says
        localizer = Localizer(Relocalizer(map_, sequence.rig, vocabulary, LoopConfig()))
        before = localizer.step(stranger)
        assert not localizer.found
        np.testing.assert_allclose(before.down, stranger.odom_T_cam[:3, 2])
        found = localizer.step(keyframe)
        assert localizer.found
        in_map = found.map_T_odom[:3, :3] @ keyframe.odom_T_cam[:3, 2]
        np.testing.assert_allclose(found.down, in_map if told is None else told, atol=1e-9)


def test_same_keyframe_same_bits(sequence: StoreSequence, first_pass: int, relocalizer: Relocalizer) -> None:
    answers = [relocalizer.locate(sequence.keyframes[first_pass + 10]) for _ in range(2)]
    assert answers[0].map_T_cam.tobytes() == answers[1].map_T_cam.tobytes()
    assert np.array_equal(answers[0].pairs, answers[1].pairs)


def test_keyframes_before_the_first_localization_are_placed_with_it(
    sequence: StoreSequence, first_pass: int, vocabulary: voc.Vocabulary
) -> None:
    part = sequence.first(first_pass)
    localizer = Localizer(Relocalizer(map_of_sequence(part).snapshot, sequence.rig, vocabulary, LoopConfig()))
    rows = range(first_pass + 5, first_pass + 9)
    keyframes = [dataclasses.replace(sequence.keyframes[k], kf_id=n) for n, k in enumerate(rows)]
    blind = [
        dataclasses.replace(k, descriptors=np.zeros_like(k.descriptors), corners=Corners.none()) for k in keyframes[:2]
    ]
    assert [len(localizer.step(k).kf_ids) for k in blind] == [0, 0]
    update = localizer.step(keyframes[2])
    assert update.kf_ids.tolist() == [0, 1, 2]
    for k, pose in zip(rows, update.map_T_kf, strict=False):
        assert np.linalg.norm((se3.inverse(true_pose(sequence, k)) @ pose)[:3, 3]) < 0.1
    assert localizer.step(keyframes[3]).kf_ids.tolist() == [3]


@pytest.mark.parametrize("astray", [False, True])
def test_a_localization_with_few_points_needs_a_second_one(
    sequence: StoreSequence, first_pass: int, vocabulary: voc.Vocabulary, astray: bool
) -> None:
    part = sequence.first(first_pass)
    saved, config = map_of_sequence(part).snapshot, LoopConfig()
    first, second = (dataclasses.replace(sequence.keyframes[first_pass + k], kf_id=n) for n, k in enumerate((6, 7)))
    seen = Relocalizer(saved, sequence.rig, vocabulary, config).locate(first).inliers
    if astray:  # odometry says that the robot drove two metres between them
        second = dataclasses.replace(second, odom_T_cam=se3.exp(np.array([2.0, 0, 0, 0, 0, 0])) @ second.odom_T_cam)
    hardly_enough = dataclasses.replace(config, relocalize_inliers=round(0.8 * seen))
    localizer = Localizer(Relocalizer(saved, sequence.rig, vocabulary, hardly_enough))
    assert len(localizer.step(first).kf_ids) == 0 and not localizer.found
    assert localizer.last is not None and localizer.last.reason == "not_confirmed_yet"
    assert localizer.step(second).kf_ids.tolist() == ([] if astray else [0, 1])
    assert localizer.found != astray


def test_a_session_continues_in_the_frame_of_the_saved_map(
    sequence: StoreSequence, first_pass: int, vocabulary: voc.Vocabulary
) -> None:
    part = sequence.first(first_pass)
    localizer = Localizer(Relocalizer(map_of_sequence(part).snapshot, sequence.rig, vocabulary, LoopConfig()))
    extension = Extension(MapperConfig(), sequence.rig, None, LoopConfig(), localizer)
    rows = range(first_pass + 5, first_pass + 15)
    odom = se3.inverse(sequence.keyframes[rows[0]].odom_T_cam)
    keyframes = [
        dataclasses.replace(sequence.keyframes[k], kf_id=n, odom_T_cam=odom @ sequence.keyframes[k].odom_T_cam)
        for n, k in enumerate(rows)
    ]
    blind = [
        dataclasses.replace(k, descriptors=np.zeros_like(k.descriptors), corners=Corners.none()) for k in keyframes[:2]
    ]
    poses = KeyframePoses()
    for keyframe in blind:
        assert np.array_equal(extension.step(keyframe).map_T_odom, np.eye(4)) and not localizer.found
    updates = [extension.step(keyframe) for keyframe in keyframes[2:]]
    for update in updates:
        poses.update(update)
    last = updates[-1].map_T_odom
    assert localizer.found and np.abs(last - np.eye(4)).max() > 0.1
    for k, pose in zip(rows, poses.all().values(), strict=True):  # those from before it was found too
        assert np.linalg.norm((se3.inverse(true_pose(sequence, k)) @ pose)[:3, 3]) < 0.1
    assert np.linalg.norm((se3.inverse(poses.all()[9]) @ last @ keyframes[9].odom_T_cam)[:3, 3]) < 0.05
    saved = localizer.saved
    assert extension.place(saved) is not None
    for name in ("kf_ids", "pt_ids"):  # of a map that was changed meanwhile
        assert extension.place(dataclasses.replace(saved, **{name: getattr(saved, name)[1:]})) is None


def test_answers_do_not_depend_on_clouds_of_earlier_questions(
    sequence: StoreSequence, first_pass: int, vocabulary: voc.Vocabulary
) -> None:
    fresh = Relocalizer(map_of_sequence(sequence.first(first_pass)).snapshot, sequence.rig, vocabulary, LoopConfig())
    asked = sequence.keyframes[first_pass + 8 : first_pass + 14]
    before = [fresh.locate(k) for k in asked]
    for a, b in zip(before, [fresh.locate(k) for k in asked], strict=True):
        assert a.map_T_cam.tobytes() == b.map_T_cam.tobytes() and np.array_equal(a.pairs, b.pairs)
