"""Several sessions of one store in one map, and pruning."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.cli import main
from stereo_sfm.config import Config, LoopConfig, MapperConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.loop import vocabulary as voc
from stereo_sfm.mapping.mapper import Mapper
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.maps.cameras import MapCamera
from stereo_sfm.maps.folders import MapFolders, save_result
from stereo_sfm.maps.joining import Joining
from stereo_sfm.maps.merge import merge, prune, share_a_session
from stereo_sfm.maps.saved_map import SavedMap, joined, load_map, save_map
from stereo_sfm.maps.store import lock
from stereo_sfm.types import LoopResult
from tests.loop.store_sequence import StoreSequence, make_sequence
from tests.maps.maps import map_of_sequence, same
from tests.synthetic import pinhole_rig


@pytest.fixture(scope="module")
def drives() -> list[StoreSequence]:
    """Two sessions in one store, each in its own frame: the first two aisles, and later the first one again."""
    both = make_sequence([0, 1, 0], seed=31)
    second = next(
        k for k in range(90, len(both.keyframes)) if both.world_T_kf[k, 2, 3] < 0 and both.world_T_kf[k, 0, 3] < 1
    )
    parts = [slice(0, second - 8), slice(second, None)]
    return [dataclasses.replace(both, keyframes=both.keyframes[p], world_T_kf=both.world_T_kf[p]) for p in parts]


@pytest.fixture(scope="module")
def vocabulary(drives: list[StoreSequence]) -> voc.Vocabulary:
    return voc.train([k.descriptors for k in drives[0].keyframes], depth=3)


@pytest.fixture(scope="module")
def maps(drives: list[StoreSequence]) -> list[SavedMap]:
    return [map_of_sequence(w) for w in drives]


@pytest.fixture(scope="module")
def merged(maps: list[SavedMap], vocabulary: voc.Vocabulary) -> SavedMap:
    result = merge(maps, vocabulary, LoopConfig())
    assert len(result.loops) >= 2
    assert result.fused > 100
    return result.saved


def test_a_merged_map_keeps_the_poses_of_both_sessions(
    drives: list[StoreSequence], maps: list[SavedMap], merged: SavedMap
) -> None:
    assert len(merged) == sum(map(len, maps))
    truth = np.concatenate([w.world_T_kf for w in drives])
    expected = se3.inverse(truth[0]) @ truth
    error = np.linalg.norm(merged.snapshot.map_T_kf[:, :3, 3] - expected[:, :3, 3], axis=1)
    aisle = np.abs(truth[:, 0, 3]) < 0.1
    assert np.sqrt((error[aisle] ** 2).mean()) < 0.05
    assert merged.sessions.tolist() == [0] * len(maps[0]) + [1] * len(maps[1])
    shared = {int(p) for p in merged.snapshot.obs_pt[merged.sessions[merged.snapshot.obs_kf] == 0]}
    shared &= {int(p) for p in merged.snapshot.obs_pt[merged.sessions[merged.snapshot.obs_kf] == 1]}
    assert len(shared) > 100


def test_a_merged_map_names_the_vocabulary_of_the_comparison(merged: SavedMap, vocabulary: voc.Vocabulary) -> None:
    assert merged.vocabulary_id == vocabulary.id


def test_wrong_observations_leave_the_map_in_the_full_adjustment(
    drives: list[StoreSequence], maps: list[SavedMap]
) -> None:
    s = maps[1].snapshot
    views = np.bincount(s.obs_pt, minlength=len(s.pt_ids))
    many, two = np.flatnonzero(views[s.obs_pt] > 4)[::400], np.flatnonzero(views[s.obs_pt] == 2)[::400]
    wrong = np.concatenate([many[:5], two[:3]])
    uv_left = s.uv_left.copy()
    uv_left[wrong] += [12.0, -9.0]
    wrong_map = dataclasses.replace(maps[1], snapshot=dataclasses.replace(s, uv_left=uv_left))
    joining = Joining(wrong_map, LoopConfig(), MapperConfig())
    joining.adjust()
    after = joining.map.snapshot()
    seen = set(zip(after.kf_ids[after.obs_kf].tolist(), after.pt_ids[after.obs_pt].tolist(), strict=True))
    for row in wrong:
        assert (int(s.kf_ids[s.obs_kf[row]]), int(s.pt_ids[s.obs_pt[row]])) not in seen
    kept = np.isin(s.pt_ids, after.pt_ids)
    assert kept[s.obs_pt[many]].all() and not kept[s.obs_pt[two]][:3].any()
    still = np.bincount(after.obs_pt, minlength=len(after.pt_ids))[np.searchsorted(after.pt_ids, s.pt_ids[kept])]
    assert (still[views[kept] >= 2] >= 2).all()
    truth = se3.inverse(drives[1].world_T_kf[0]) @ drives[1].world_T_kf
    error = np.linalg.norm(after.map_T_kf[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert np.sqrt((error**2).mean()) < 0.02


def test_maps_without_common_points_are_not_merged(maps: list[SavedMap], vocabulary: voc.Vocabulary) -> None:
    stranger = map_of_sequence(make_sequence([0], seed=99))
    with pytest.raises(StereoSfmError, match="2 separate maps: no loop joins them"):
        merge([maps[1], stranger], vocabulary, LoopConfig())


def test_maps_of_one_and_of_two_cameras_are_not_merged(maps: list[SavedMap]) -> None:
    with pytest.raises(StereoSfmError, match="cannot be merged: one camera instead of two cameras"):
        joined([maps[0], dataclasses.replace(maps[1], cameras={0: MapCamera(Rig(pinhole_rig().left))})])


def test_a_session_is_found_in_the_map(maps: list[SavedMap], merged: SavedMap) -> None:
    for saved in maps:
        assert share_a_session(saved, saved)
        assert share_a_session(merged, saved)
    part = np.arange(len(maps[0])) < 20
    s = maps[0].snapshot
    snapshot = dataclasses.replace(s, **{f: getattr(s, f)[part[s.obs_kf]] for f in ("obs_kf", "obs_pt", "uv_left")})
    assert share_a_session(dataclasses.replace(maps[0], snapshot=snapshot), maps[0])
    assert not share_a_session(maps[0], maps[1])
    again = map_of_sequence(make_sequence([0, 1], seed=31, noise_px=0.3))  # the same times, images of their own
    assert set(again.snapshot.stamp_ns.tolist()) & set(s.stamp_ns.tolist())
    assert not share_a_session(maps[0], again)


def test_side_by_side_keeps_every_row(maps: list[SavedMap]) -> None:
    both = joined(maps).snapshot
    first = len(maps[0].snapshot.obs_kf)
    assert np.array_equal(both.obs_kf[first:] - len(maps[0]), maps[1].snapshot.obs_kf)
    assert np.array_equal(
        both.points[both.obs_pt[first:]], maps[1].snapshot.points[maps[1].snapshot.obs_pt], equal_nan=True
    )
    assert len(np.unique(both.kf_ids)) == len(both.kf_ids) and len(np.unique(both.pt_ids)) == len(both.pt_ids)


def test_prune_by_sessions_removes_points_that_the_newest_session_did_not_observe(merged: SavedMap) -> None:
    pruned = prune(merged, unseen_sessions=1)
    s = pruned.snapshot
    assert 0 < len(s.pt_ids) < len(merged.snapshot.pt_ids)
    newest = np.full(len(s.pt_ids), -1)
    np.maximum.at(newest, s.obs_pt, pruned.sessions[s.obs_kf])
    assert (newest == 1).all()
    assert (np.bincount(s.obs_kf, minlength=len(pruned)) > 0).all()
    assert (s.anchors >= 0).all() and (s.anchors < len(pruned)).all()


def test_prune_of_nothing_changes_nothing(maps: list[SavedMap]) -> None:
    seen = np.unique(maps[0].snapshot.obs_kf)
    kept = prune(maps[0], min_views=0)
    assert len(kept) == len(seen)  # keyframes that see no point go
    assert np.array_equal(kept.snapshot.points, maps[0].snapshot.points)
    assert np.array_equal(kept.snapshot.map_T_kf, maps[0].snapshot.map_T_kf[seen])
    assert same(prune(kept, min_views=0).snapshot, kept.snapshot)
    with pytest.raises(StereoSfmError, match="empty map"):
        prune(maps[0], min_views=10_000)


def test_commands(
    tmp_path: Path, maps: list[SavedMap], vocabulary: voc.Vocabulary, capsys: pytest.CaptureFixture[str]
) -> None:
    from stereo_sfm.loop.vocabulary_file import save_vocabulary

    save_vocabulary(vocabulary, tmp_path / "v.npz")
    for name, saved in zip("ab", maps, strict=True):
        save_map(saved, tmp_path / name)
    a, b, both = str(tmp_path / "a"), str(tmp_path / "b"), str(tmp_path / "both")
    vocabulary_option = ["--set", f"loop.vocabulary={tmp_path / 'v.npz'}"]
    assert main(["map", "merge", a, b, "-o", both, *vocabulary_option]) == 0
    assert "2 maps joined by" in capsys.readouterr().out
    assert len(load_map(Path(both))) == len(maps[0]) + len(maps[1])
    assert main(["map", "merge", a, b, "-o", both]) == 2
    assert "holds a map: choose another -o" in capsys.readouterr().err
    assert main(["map", "merge", a, "-o", str(tmp_path / "c")]) == 2
    assert "at least two maps" in capsys.readouterr().err
    for pair in ([a, a], [both, b]):
        assert main(["map", "merge", *pair, "-o", str(tmp_path / "c")]) == 2
        error = capsys.readouterr().err
        assert f"{pair[0]} and {pair[1]} contain the same session" in error and len(error.splitlines()) == 1
    assert not (tmp_path / "c").exists()
    assert main(["map", "prune", both, "--min-views", "3", "-o", str(tmp_path / "d")]) == 0
    assert len(load_map(tmp_path / "d").snapshot.pt_ids) < len(load_map(Path(both)).snapshot.pt_ids)


@pytest.mark.parametrize(
    "option",
    ["--min-views=-3", "--unseen-sessions=-1", "--min-seen-share=nan", "--min-seen-share=-0.1", "--min-seen-share=1.5"],
)
def test_prune_refuses_numbers_out_of_range(
    tmp_path: Path, maps: list[SavedMap], option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    save_map(maps[1], tmp_path / "m")
    assert main(["map", "prune", str(tmp_path / "m"), option, "-o", str(tmp_path / "p")]) == 2
    error = capsys.readouterr().err
    assert option.split("=")[0] in error and len(error.splitlines()) == 1
    assert not (tmp_path / "p").exists()


def test_a_given_place_merges_maps_that_the_search_does_not(
    drives: list[StoreSequence], maps: list[SavedMap], vocabulary: voc.Vocabulary
) -> None:
    blind = LoopConfig(min_inliers=10**6)
    with pytest.raises(StereoSfmError, match="remain 2 separate maps"):
        merge(maps, vocabulary, blind)
    here = 5
    distance = np.linalg.norm(drives[0].world_T_kf[:, :3, 3] - drives[1].world_T_kf[here, :3, 3], axis=1)
    there = int(np.argmin(distance))
    physical = {drives[0].physical[p]: p for p in maps[0].snapshot.pt_ids.tolist()}
    seen = [p for p in maps[1].snapshot.pt_ids.tolist() if drives[1].physical[p] in physical]
    place = LoopResult(
        kf_id=int(maps[1].snapshot.kf_ids[here]),
        candidate_kf_id=int(maps[0].snapshot.kf_ids[there]),
        candidate_T_kf=se3.inverse(drives[0].world_T_kf[there]) @ drives[1].world_T_kf[here],
        information=np.eye(6) * 1e4,
        matches=np.array([[physical[drives[1].physical[p]], p] for p in seen[:100]]),
        inliers=100,
        score=0.0,
        reason="",
    )
    result = merge(maps, vocabulary, blind, place=place)
    assert len(result.loops) == 1 and result.fused == 100
    error = np.linalg.norm(
        result.saved.snapshot.map_T_kf[len(maps[0]) :, :3, 3]
        - (se3.inverse(drives[0].world_T_kf[0]) @ drives[1].world_T_kf)[:, :3, 3],
        axis=1,
    )
    assert np.median(error) < 0.1


def test_a_merged_map_is_connected(merged: SavedMap, maps: list[SavedMap], vocabulary: voc.Vocabulary) -> None:
    """The loops between its sessions are not in the file: with a third map they still count as connected."""
    with pytest.raises(StereoSfmError, match="the 2 maps remain 2 separate maps"):
        merge([merged, maps[1]], vocabulary, LoopConfig(min_inliers=10**6))


@pytest.mark.parametrize("in_place", [True, False])
def test_a_failed_merge_keeps_the_maps(
    tmp_path: Path, drives: list[StoreSequence], maps: list[SavedMap], in_place: bool
) -> None:
    save_map(maps[0], tmp_path / "store")
    mapper = Mapper(MapperConfig(), drives[1].rig)
    for k, keyframe in enumerate(drives[1].keyframes[:5]):
        mapper.step(dataclasses.replace(keyframe, kf_id=k))
    out = tmp_path / ("store" if in_place else "other")
    config = Config(loop=LoopConfig(min_inliers=10**6))
    with pytest.raises(StereoSfmError, match="contains this session alone"):
        save_result(mapper, config, MapFolders(tmp_path / "store", map_out=out))
    assert len(load_map(tmp_path / "store", drives[0].rig)) == len(maps[0])
    assert len(load_map(tmp_path / "store_walk1" if in_place else out, drives[0].rig)) == len(
        mapper.map.living_keyframes()
    )


@pytest.mark.parametrize("map_in", ["store", "other", None])
def test_a_session_is_not_merged_into_a_store_that_another_process_writes(
    tmp_path: Path, drives: list[StoreSequence], maps: list[SavedMap], map_in: str | None
) -> None:
    for name in ("store", "other"):
        save_map(maps[0], tmp_path / name)
    mapper = Mapper(MapperConfig(), drives[1].rig)
    for k, keyframe in enumerate(drives[1].keyframes[:5]):
        mapper.step(dataclasses.replace(keyframe, kf_id=k))
    with (
        lock(tmp_path / "store"),
        pytest.raises(StereoSfmError, match=r"another run is writing to .* contains this session alone"),
    ):
        save_result(mapper, Config(), MapFolders(map_in and tmp_path / map_in, map_out=tmp_path / "store"))
    assert len(load_map(tmp_path / "store", drives[0].rig)) == len(maps[0])
    assert len(load_map(tmp_path / "store_walk1", drives[0].rig)) == len(mapper.map.living_keyframes())


class Placed(Mapper):
    """Remembers which map it was asked for a place in."""

    asked: MapSnapshot | None = None

    def place(self, of: MapSnapshot | None = None) -> LoopResult | None:
        self.asked = of
        return None


def test_a_session_is_placed_in_the_map_that_it_is_merged_with(
    tmp_path: Path, drives: list[StoreSequence], maps: list[SavedMap]
) -> None:
    """Ids of the map that the run began with may name other points of one that was changed meanwhile."""
    save_map(maps[0], tmp_path / "store")
    mapper = Placed(MapperConfig(), drives[1].rig)
    for k, keyframe in enumerate(drives[1].keyframes[:5]):
        mapper.step(dataclasses.replace(keyframe, kf_id=k))
    config = Config(loop=LoopConfig(min_inliers=10**6))
    with pytest.raises(StereoSfmError, match="contains this session alone"):
        save_result(mapper, config, MapFolders(tmp_path / "store", map_out=tmp_path / "other"))
    assert mapper.asked is not None and same(mapper.asked, load_map(tmp_path / "store").snapshot)


def test_a_store_that_another_process_writes_is_not_replaced(
    tmp_path: Path, maps: list[SavedMap], capsys: pytest.CaptureFixture[str]
) -> None:
    save_map(maps[0], tmp_path / "store")
    save_map(maps[1], tmp_path / "other")
    store, other = str(tmp_path / "store"), str(tmp_path / "other")
    before = (tmp_path / "store" / "map.json").read_bytes()
    with lock(tmp_path / "store"):
        for command in (["prune", store, "--min-views", "3"], ["merge", store, other]):
            assert main(["map", *command, "-o", store, "--overwrite"]) == 2
            assert "another run is writing to" in capsys.readouterr().err
    assert (tmp_path / "store" / "map.json").read_bytes() == before
    assert main(["map", "prune", store, "--min-views", "3", "-o", store, "--overwrite"]) == 0
    assert (tmp_path / "store" / "map.json").read_bytes() != before
