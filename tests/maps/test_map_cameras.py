"""Sessions of corrected and of other cameras in one map: each keyframe keeps its own rig."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import LoopConfig, MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop import vocabulary as voc
from stereo_sfm.loop.place_view import seen_by, widest
from stereo_sfm.mapping.bundle import Bundle, BundleConfig, bundle_adjust
from stereo_sfm.maps.cameras import MapCamera, difference, unified
from stereo_sfm.maps.merge import merge
from stereo_sfm.maps.relocalization import Relocalizer
from stereo_sfm.maps.saved_map import SavedMap, joined, load_map, save_map
from stereo_sfm.maps.update import update
from stereo_sfm.types import F64
from tests.loop.store_sequence import StoreSequence, make_sequence
from tests.maps.maps import map_of_sequence, small_map
from tests.synthetic import camera_path, fisheye_rig, pinhole_rig, points_around, turned

TERMS = np.array([2e-3, -1e-3, 1e-3, 0, 0, 0, 0, 0])  # of a correction
KNOCKED = turned(fisheye_rig(), (0.3, -0.3, 0.2))  # by up to 1.5 px, and 20 % of the distance of a shelf
SEED = 31


@pytest.fixture(scope="module")
def first() -> StoreSequence:
    return make_sequence([0], seed=SEED)


@pytest.fixture(scope="module")
def vocabulary(first: StoreSequence) -> voc.Vocabulary:
    return voc.train([k.descriptors for k in first.keyframes], depth=3)


def later(rig: Rig) -> StoreSequence:
    """The same aisle an hour later, by another rig."""
    sequence = make_sequence([0], seed=SEED, rig=rig)
    moved = [dataclasses.replace(k, stamp_ns=k.stamp_ns + 3600 * 10**9) for k in sequence.keyframes]
    return dataclasses.replace(sequence, keyframes=moved)


def error_m(saved: SavedMap, sequences: list[StoreSequence]) -> float:
    """Largest error of a position, against the first keyframe."""
    truth = np.concatenate([s.world_T_kf for s in sequences])
    expected = se3.inverse(truth[0]) @ truth
    return float(np.linalg.norm(saved.snapshot.map_T_kf[:, :3, 3] - expected[:, :3, 3], axis=1).max())


def right_share(saved: SavedMap, session: int) -> float:
    """Share of a session's observations whose right pixel agreed in the adjustment of the whole map."""
    s = saved.snapshot
    return float(np.isfinite(s.uv_right[saved.sessions[s.obs_kf] == session, 0]).mean())


@pytest.mark.parametrize("rig", [KNOCKED, pinhole_rig()], ids=["knocked", "another camera"])
def test_sessions_of_two_rigs_are_merged(first: StoreSequence, vocabulary: voc.Vocabulary, rig: Rig) -> None:
    second = later(rig)
    result = merge([map_of_sequence(first), map_of_sequence(second)], vocabulary, LoopConfig())
    assert len(result.loops) >= 2
    assert result.fused > 100
    assert error_m(result.saved, [first, second]) < 0.03
    assert [result.saved.cameras[k].rig for k in (0, 1)] == [first.rig, rig]
    assert min(right_share(result.saved, session) for session in (0, 1)) > 0.9
    assert result.saved.rig is rig


def test_one_rig_for_both_would_be_wrong(first: StoreSequence, vocabulary: voc.Vocabulary) -> None:
    """What the test above could not tell if pixels of one rig were taken for those of the other."""
    second = later(KNOCKED)
    taken = dataclasses.replace(map_of_sequence(second), cameras={0: MapCamera(first.rig)})
    result = merge([map_of_sequence(first), taken], vocabulary, LoopConfig())
    assert right_share(result.saved, 1) < 0.85


@pytest.mark.parametrize("rig", [KNOCKED, pinhole_rig()], ids=["knocked", "another camera"])
def test_a_session_of_another_rig_goes_into_the_map(first: StoreSequence, vocabulary: voc.Vocabulary, rig: Rig) -> None:
    second = later(rig)
    result = update(map_of_sequence(first), map_of_sequence(second), vocabulary, LoopConfig(), MapperConfig())
    assert error_m(result.saved, [first, second]) < 0.03
    assert [result.saved.cameras[k].rig for k in (0, 1)] == [first.rig, rig]


@pytest.mark.parametrize("rig", [KNOCKED, pinhole_rig()], ids=["knocked", "another camera"])
def test_a_camera_is_found_in_the_map_of_another_rig(
    first: StoreSequence, vocabulary: voc.Vocabulary, rig: Rig
) -> None:
    saved = map_of_sequence(first)
    relocalizer = Relocalizer(saved.snapshot, rig, vocabulary, LoopConfig(), saved.keyframe_rigs([rig]))
    second = make_sequence([0], seed=SEED, rig=rig, noise_px=0.2)
    expected = se3.inverse(first.world_T_kf[0]) @ second.world_T_kf
    found = [relocalizer.locate(k) for k in second.keyframes[8:24:4]]
    assert [f.reason for f in found] == [""] * 4
    off = [np.linalg.norm(f.map_T_cam[:3, 3] - t[:3, 3]) for f, t in zip(found, expected[8:24:4], strict=True)]
    assert max(off) < 0.03


def test_a_corrected_camera_is_compared_by_its_corrected_rig(first: StoreSequence, vocabulary: voc.Vocabulary) -> None:
    saved = map_of_sequence(first)
    own = saved.keyframe_rigs([first.rig])
    told, not_told = (Relocalizer(saved.snapshot, first.rig, vocabulary, LoopConfig(), own) for _ in range(2))
    told.use(KNOCKED)
    keyframe = make_sequence([0], seed=SEED, rig=KNOCKED, noise_px=0.2).keyframes[12]
    truth = se3.inverse(first.world_T_kf[0]) @ first.world_T_kf[12]
    off = [se3.extent(se3.inverse(truth) @ r.locate(keyframe).map_T_cam)[1] for r in (told, not_told)]
    assert off[0] < 0.2 * off[1]


def test_a_bundle_of_two_rigs_is_that_of_each() -> None:
    rigs, rng = [pinhole_rig(0.1), turned(pinhole_rig(0.3), (0.5, 1.0, -0.5))], np.random.default_rng(0)
    poses = camera_path(8)
    points = points_around(poses, 400, rng)
    which = np.arange(len(poses)) % 2
    parts: list[tuple[int, F64, F64, F64]] = []
    for k, pose in enumerate(poses):
        seen = se3.transform(se3.inverse(pose), points)
        left, right = rigs[which[k]].left.project(seen), rigs[which[k]].project_right(seen)
        rows = np.flatnonzero(rigs[0].left.inside(left) & rigs[0].left.inside(right) & (seen[:, 2] > 0.3))
        parts.append((k, rows.astype(float), left[rows], right[rows]))
    obs_kf = np.concatenate([np.full(len(r), k) for k, r, _, _ in parts])
    obs_pt = np.concatenate([r for _, r, _, _ in parts]).astype(np.int64)
    start = poses @ se3.exp(rng.normal(0, 0.005, (len(poses), 6)))
    start[0] = poses[0]
    bundle = Bundle(
        start, np.arange(len(poses)) < 1, points + rng.normal(0, 0.02, points.shape), obs_kf, obs_pt,
        np.concatenate([u for _, _, u, _ in parts]), np.concatenate([u for _, _, _, u in parts]), kf_rig=which,
    )  # fmt: skip
    config = BundleConfig(rounds=1, iterations=30, tolerance=1e-12)
    assert np.abs(bundle_adjust(rigs, bundle, config).world_T_kf - poses).max() < 1e-6
    assert (
        np.abs(bundle_adjust(rigs[0], dataclasses.replace(bundle, kf_rig=None), config).world_T_kf - poses).max() > 0.01
    )


def test_pixels_as_another_rig_sees_them() -> None:
    own, rig, rng = fisheye_rig(), pinhole_rig(0.3), np.random.default_rng(2)
    points = rng.uniform([-1, -1, 1], [1, 1, 4], (100, 3))
    left, right = seen_by(rig, own, own.left.project(points), own.project_right(points), points)
    np.testing.assert_allclose(left, rig.left.project(points), atol=1e-6)
    np.testing.assert_allclose(right, rig.project_right(points), atol=1e-6)
    assert widest([rig, own]) is own


def test_equal_rigs_become_one_object() -> None:
    a, b, c = fisheye_rig(), fisheye_rig(), with_terms(fisheye_rig(), TERMS)
    one, two, three = unified([a, b, c])
    assert one is a
    assert two is a
    assert three is c


def test_the_cameras_of_sessions_are_saved(tmp_path: Path) -> None:
    _, saved = small_map()
    calibrated = dataclasses.replace(saved.rig, serial="A1")
    corrected = dataclasses.replace(saved, cameras={0: MapCamera(calibrated, TERMS)})
    save_map(joined([saved, corrected, corrected]), tmp_path / "m")
    back = load_map(tmp_path / "m")
    assert sorted(back.cameras) == [0, 1, 2]
    assert not back.cameras[0].terms.any()
    assert back.cameras[2].calibrated.serial == "A1"
    assert back.cameras[2].terms.tobytes() == TERMS.tobytes()
    assert back.rig.left_T_right.tobytes() == with_terms(calibrated, TERMS).left_T_right.tobytes()
    assert (tmp_path / "m" / "cameras.yaml").read_text().count("left_T_right") == 2


def test_maps_of_one_rig_for_all_are_read(tmp_path: Path) -> None:
    _, saved = small_map()
    save_map(saved, tmp_path / "m")
    (tmp_path / "m" / "cameras.yaml").unlink()
    head = json.loads((tmp_path / "m" / "map.json").read_text())
    del head["sha256"]["cameras"]
    (tmp_path / "m" / "map.json").write_text(json.dumps({**head, "version": 4}))
    back = load_map(tmp_path / "m", saved.rig)
    assert difference(back.rig, saved.rig) == ""


def test_a_session_without_a_camera_is_a_damaged_map(tmp_path: Path) -> None:
    _, saved = small_map()
    save_map(saved, tmp_path / "m")
    path = tmp_path / "m" / "cameras.yaml"
    path.write_text(path.read_text().replace("corrections: {0:", "corrections: {4:"))
    head = json.loads((tmp_path / "m" / "map.json").read_text())
    head["sha256"]["cameras"] = hashlib.sha256(path.read_bytes()).hexdigest()
    (tmp_path / "m" / "map.json").write_text(json.dumps(head))
    with pytest.raises(Exception, match=r"damaged: cameras\.yaml lacks a session"):
        load_map(tmp_path / "m")


def test_another_camera_is_welcome_and_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    _, saved = small_map()
    save_map(dataclasses.replace(saved, cameras={0: MapCamera(saved.rig, TERMS)}), tmp_path / "m")
    with caplog.at_level(logging.WARNING):
        load_map(tmp_path / "m", saved.rig)  # as it was before the correction
        load_map(tmp_path / "m", with_terms(saved.rig, -TERMS))  # and with another one
        assert caplog.text == ""
        load_map(tmp_path / "m", pinhole_rig())
    assert "another camera: this one has left lens pinhole instead of kannala_brandt" in caplog.text


def test_what_differs() -> None:
    rig = pinhole_rig()
    other = dataclasses.replace(turned(pinhole_rig(0.12), (0, 0.05, 0)), serial="B")
    assert difference(rig, other) == "baseline 120.0 instead of 100.0 mm, the right camera turned by 0.050 deg"
    assert difference(dataclasses.replace(rig, serial="A"), other).startswith("serial number B instead of A")
    assert difference(rig, turned(rig, (0, 0.3, 0)), corrected=True) == ""
    assert difference(rig, turned(rig, (0, 0.7, 0)), corrected=True) == "the right camera turned by 0.700 deg"
    assert difference(rig, Rig(rig.left)) == "one camera instead of two cameras"
