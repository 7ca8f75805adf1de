"""Sessions put into one map: its frame stays, its size stays bounded, and what is no longer there is forgotten."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.cli import main
from stereo_sfm.commands._stop import INTERRUPTED
from stereo_sfm.config import Config, LoopConfig, MapperConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.loop import vocabulary as voc
from stereo_sfm.maps.changes import changed_cells, describe_changes
from stereo_sfm.maps.labels import Aisle
from stereo_sfm.maps.replace_folder import replaced_folder
from stereo_sfm.maps.saved_map import SavedMap, load_map, map_files, save_map
from stereo_sfm.maps.store import load_current, lock, read_about, undo, versions, versions_folder, write_version
from stereo_sfm.maps.unfinished import publish, save_session
from stereo_sfm.maps.update import KEPT_SESSIONS, Update, update
from stereo_sfm.types import F64, U8, Keyframe
from tests.loop.store_sequence import StoreSequence, make_sequence
from tests.maps.maps import map_of_sequence, same, small_map

SESSIONS = 6
ALONG = 3.0, 6.0  # metres along the aisle where the left shelf is exchanged
EXCHANGED = 2  # first session that sees other products there
FLOOR = np.array([[0, -1.0, 0], [0, 0, -1.0], [1.0, 0, 0]])  # x ahead, y left, z up in the first camera


@pytest.fixture(scope="module")
def walks() -> list[StoreSequence]:
    """Drives down one aisle, each in its own frame; in later ones a part of the left shelf holds other products."""
    whole = make_sequence([0] * SESSIONS, seed=5, max_points=150)
    ahead = whole.world_T_kf[:, 2, 2] > 0.5
    begins = np.flatnonzero(ahead & ~np.concatenate([[False], ahead[:-1]]))
    parts = [slice(b, b + int(np.argmin(np.append(ahead[b:], False)))) for b in begins.tolist()]
    assert len(parts) == SESSIONS
    out: list[StoreSequence] = []
    for k, part in enumerate(parts):
        poses = whole.world_T_kf[part]
        keyframes = whole.keyframes[part]
        if k >= EXCHANGED:
            keyframes = [_exchanged(f, p) for f, p in zip(keyframes, poses, strict=True)]
        out.append(dataclasses.replace(whole, keyframes=keyframes, world_T_kf=poses))
    return out


def _exchanged(keyframe: Keyframe, world_T_kf: F64) -> Keyframe:
    """What stands on the exchanged part looks otherwise."""

    def other(points: F64, descriptors: U8) -> U8:
        at = se3.transform(world_T_kf, np.nan_to_num(points, nan=1e6))
        return np.where(_exchanged_place(at)[:, None], descriptors ^ 0x5B, descriptors)

    corners = keyframe.corners
    return dataclasses.replace(
        keyframe,
        descriptors=other(keyframe.points_cam, keyframe.descriptors),
        corners=dataclasses.replace(corners, descriptors=other(corners.points_cam.astype(float), corners.descriptors)),
    )


def _exchanged_place(xyz: F64) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return (xyz[:, 0] < 0) & (xyz[:, 2] > ALONG[0]) & (xyz[:, 2] < ALONG[1])


@pytest.fixture(scope="module")
def vocabulary(walks: list[StoreSequence]) -> voc.Vocabulary:
    return voc.train([k.descriptors for k in walks[0].keyframes], depth=3)


@pytest.fixture(scope="module")
def updates(walks: list[StoreSequence], vocabulary: voc.Vocabulary) -> list[Update]:
    saved, out = map_of_sequence(walks[0]), list[Update]()
    for walk in walks[1:]:
        out.append(update(saved, map_of_sequence(walk), vocabulary, LoopConfig(), MapperConfig()))
        saved = out[-1].saved
    return out


def test_a_session_is_put_into_the_frame_of_the_map(walks: list[StoreSequence], vocabulary: voc.Vocabulary) -> None:
    saved = map_of_sequence(walks[0])
    done = update(saved, map_of_sequence(walks[1]), vocabulary, LoopConfig(), MapperConfig())
    s = done.saved.snapshot
    assert len(done.saved) == len(saved) + len(walks[1].keyframes) and not done.forgotten
    assert done.fused > 50 and done.saved.session_ids == [0, 1]
    poses = np.concatenate([walk.world_T_kf for walk in walks[:2]])
    metres, radians = se3.extent(se3.inverse(se3.inverse(poses[0]) @ poses) @ s.map_T_kf)
    assert metres.max() < 0.02 and np.degrees(radians).max() < 0.3


def test_the_session_of_a_service_is_put_into_the_map_that_it_continues(
    walks: list[StoreSequence], vocabulary: voc.Vocabulary, tmp_path: Path
) -> None:
    """Where its first relocalization says, in any number of sessions: old ones are forgotten as by `map update`."""
    saved, walk = (map_of_sequence(w) for w in walks[:2])
    begins, points = (int(ids.max()) + 1 for ids in (saved.snapshot.kf_ids, saved.snapshot.pt_ids))
    found = update(saved, walk, vocabulary, LoopConfig(), MapperConfig()).loops
    loop = next(one for one in found if one.candidate_kf_id < begins <= one.kf_id)
    place = dataclasses.replace(loop, kf_id=loop.kf_id - begins, matches=loop.matches - np.array([0, points]))
    base, session, out = (tmp_path / name for name in ("base", "session", "out"))
    save_map(saved, base)
    save_session(walk, None, session)
    with pytest.raises(StereoSfmError, match="was not found in the saved map"):
        publish(base, session, out, Config())
    save_session(walk, place, session)
    assert publish(base, session, out, Config()) == len(saved) + len(walk)
    s = load_map(out).snapshot
    poses = np.concatenate([one.world_T_kf for one in walks[:2]])
    metres, radians = se3.extent(se3.inverse(se3.inverse(poses[0]) @ poses) @ s.map_T_kf)
    assert metres.max() < 0.03 and np.degrees(radians).max() < 0.3


@pytest.mark.slow
def test_the_frame_of_the_map_stays(walks: list[StoreSequence], updates: list[Update]) -> None:
    begin = se3.inverse(walks[0].world_T_kf[0])
    for k, done in enumerate(updates, 1):
        s, sessions = done.saved.snapshot, done.saved.sessions
        newest = sessions == done.session
        assert done.session == k and newest.sum() == len(walks[k].keyframes)
        true = begin @ walks[k].world_T_kf
        metres, radians = se3.extent(se3.inverse(true) @ s.map_T_kf[newest])
        assert metres.max() < 0.02 and np.degrees(radians).max() < 0.3


@pytest.mark.slow
def test_the_size_is_bounded_by_the_store(walks: list[StoreSequence], updates: list[Update]) -> None:
    each = max(len(walk.keyframes) for walk in walks)
    counts = [len(done.saved) for done in updates]
    assert max(counts) <= (KEPT_SESSIONS + 1) * each
    assert updates[-1].forgotten > 0.5 * each
    s = updates[-1].saved.snapshot
    assert s.kf_ids.tolist() == list(range(len(s.kf_ids))) and int(s.pt_ids.max()) == len(s.pt_ids) - 1
    assert len(s.pt_ids) < 1.3 * len(updates[1].saved.snapshot.pt_ids)


@pytest.mark.slow
def test_exchanged_products_are_forgotten_and_others_kept(updates: list[Update]) -> None:
    done = updates[-1]
    s, sessions = done.saved.snapshot, done.saved.sessions
    oldest = np.full(len(s.pt_ids), SESSIONS)
    np.minimum.at(oldest, s.obs_pt, sessions[s.obs_kf])
    first = s.map_T_kf[0]
    assert np.abs(first[:3, :3] - np.eye(3)).max() < 0.05  # the map's axes are the first session's
    there = _exchanged_place(s.points + np.array([0, 0, -1.5]))
    inner = there & (s.points[:, 2] > ALONG[0] + 2.0) & (s.points[:, 2] < ALONG[1] + 1.0)
    assert inner.sum() > 20
    assert (oldest[inner] < EXCHANGED).mean() < 0.05
    assert (sessions[s.obs_kf] >= SESSIONS - KEPT_SESSIONS).mean() > 0.6


@pytest.mark.slow
def test_changes_are_named(updates: list[Update]) -> None:
    map_T_floor = se3.from_rotation_translation(FLOOR, np.array([0, 1.3, 0]))
    aisle = Aisle("aisle 4", (-1.5, 0.0), (11.0, 0.0))
    shown = describe_changes(changed_cells(updates[EXCHANGED - 1], map_T_floor), [aisle])
    changed = [line for line in shown if line.endswith("changed")]
    assert changed and all(line.startswith("aisle 4, left") for line in changed), shown
    before = describe_changes(changed_cells(updates[EXCHANGED - 2], map_T_floor), [aisle])
    assert not [line for line in before if line.endswith("changed")]


def test_cells_become_lines_of_text() -> None:
    aisles = [Aisle("aisle 4", (0.0, 0.0), (0.0, 12.0)), Aisle("back wall", (0.0, 20.0), (9.0, 20.0))]
    cells = [("new", -0.5, 2.5), ("new", -0.5, 3.5), ("new", 1.5, 3.5), ("changed", 4.5, 20.5), ("new", -30.5, 40.5)]
    assert describe_changes(cells, aisles) == [
        "aisle 4, left, 2-4 m: new",
        "aisle 4, right, 3-4 m: new",
        "back wall, left, 4-5 m: changed",
        "y 40.5 m, x -31 to -30 m: new",
    ]


def test_a_session_of_another_store_or_one_known_is_refused(
    walks: list[StoreSequence], vocabulary: voc.Vocabulary
) -> None:
    saved = map_of_sequence(walks[0])
    other = map_of_sequence(make_sequence([0], seed=77))
    with pytest.raises(StereoSfmError, match="not found in the map"):
        update(saved, other, vocabulary, LoopConfig(), MapperConfig())
    with pytest.raises(StereoSfmError, match="in the map already"):
        update(saved, saved, vocabulary, LoopConfig(), MapperConfig())


def test_versions_undo_labels_and_what_people_put_beside(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maps = [small_map(seed)[1] for seed in range(2)] * 2
    store = tmp_path / "store"
    numbers = [write_version(store, m, [f"session {k}"], keep=3) for k, m in enumerate([*maps, maps[0]])]
    assert numbers == [0, 1, 2, 3, 4] and versions(store) == [1, 2, 3]
    (store / "keepout.png").write_bytes(b"drawn")
    floor = read_about(store).map_T_floor
    assert main(["map", "label", str(store), "aisle 4", "0,0", "9.5,0"]) == 0
    assert main(["map", "label", str(store), "aisle 5"]) == 2
    write_version(store, maps[1], ["again"], keep=3)
    about = read_about(store)
    assert about.version == 5 and about.aisles == (Aisle("aisle 4", (0, 0), (9.5, 0)),)
    assert np.array_equal(about.map_T_floor, floor)
    assert (store / "keepout.png").read_bytes() == b"drawn"
    capsys.readouterr()
    assert main(["map", "versions", str(store)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "  again"
    assert main(["map", "undo", str(store)]) == 0
    assert same(load_map(store).snapshot, _as_saved(maps[0], tmp_path).snapshot)
    assert read_about(store).version == 4 and (store / "keepout.png").exists() and read_about(store).aisles
    assert main(["map", "undo", str(store)]) == 0
    assert main(["map", "undo", str(store)]) == 0
    assert main(["map", "undo", str(store)]) == 2  # version 1 was not kept
    assert main(["map", "label", str(store), "aisle 4", "--remove"]) == 0
    assert not read_about(store).aisles


def test_a_store_begun_again_keeps_its_own_versions(tmp_path: Path) -> None:
    """And those of the one that was there before go first."""
    store, saved = tmp_path / "store", small_map()[1]
    for number in (4, 6):
        save_map(saved, versions_folder(store) / f"{number:05d}")
    for k, kept in enumerate(([4, 6], [0, 6], [0, 1])):
        assert write_version(store, saved, [], keep=2) == k and versions(store) == kept
    with lock(store):
        assert [undo(store), undo(store)] == [1, 0]


def _as_saved(saved: SavedMap, folder: Path) -> SavedMap:
    save_map(saved, folder / "other")
    return load_map(folder / "other")


def test_labels_and_plans_while_a_service_extends_the_map(tmp_path: Path) -> None:
    saved, store = small_map()[1], tmp_path / "store"
    save_map(saved, store)
    with lock(store), replaced_folder(store, map_files()) as draft:  # a save under way
        for path in store.iterdir():
            (draft / path.name).write_bytes(path.read_bytes())
        assert main(["map", "label", str(store), "aisle 4", "0,0", "9.5,0"]) == 0
        assert main(["map", "plan", str(store)]) == 0
        assert main(["map", "update", str(store), str(store)]) == 2
    assert [aisle.name for aisle in read_about(store).aisles] == ["aisle 4"]
    assert (store / "floor_plan.pgm").exists() and same(load_map(store).snapshot, saved.snapshot)


def test_a_walk_that_was_interrupted_is_no_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the command cannot be repeated: a part of the walk is in the store."""
    from stereo_sfm.commands import _execute

    def stopped(options: _execute.RunOptions) -> tuple[int, Path]:
        assert options.output is not None
        save_map(small_map()[1], options.output / "map")
        return INTERRUPTED, options.output

    monkeypatch.setattr(_execute, "execute", stopped)
    assert main(["map", "update", str(tmp_path / "store"), "sim:loop"]) == INTERRUPTED
    assert not (tmp_path / "store").exists()


def test_a_map_that_is_replaced_while_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps, store, read = [small_map(seed)[1] for seed in range(2)], tmp_path / "store", list[int]()
    save_map(maps[0], store)

    def replaced(folder: Path) -> SavedMap:
        read.append(1)
        if len(read) == 1:
            save_map(maps[1], store)
            raise StereoSfmError("damaged: files of two versions")
        return load_map(folder)

    monkeypatch.setattr("stereo_sfm.maps.store.load_map", replaced)
    assert len(load_current(store).snapshot.pt_ids) == len(maps[1].snapshot.pt_ids) and len(read) == 2
    (store / "points.npz").write_bytes(b"damaged")
    with pytest.raises(StereoSfmError):
        load_current(store)


def test_only_one_writer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "store"
    write_version(store, small_map()[1], [])
    held = lock(store)
    assert main(["map", "undo", str(store)]) == 2
    assert "is writing" in capsys.readouterr().err
    held.release()
    assert main(["map", "undo", str(store)]) == 2
    assert "no earlier version" in capsys.readouterr().err
