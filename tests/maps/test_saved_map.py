"""Map folders: round trips to the bit, extension, and one line for each error."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.maps.saved_map import SavedMap, load_map, restore_map, save_map
from tests.maps.maps import same, small_map


@pytest.fixture(scope="module")
def saved() -> SavedMap:
    return small_map()[1]


def test_round_trip_to_the_bit(tmp_path: Path, saved: SavedMap) -> None:
    save_map(saved, tmp_path / "a")
    back = load_map(tmp_path / "a", saved.rig)
    assert same(back.snapshot, saved.snapshot)
    save_map(back, tmp_path / "b")
    for name in (
        "map.json",
        "rig.yaml",
        "cameras.yaml",
        "keyframes.npz",
        "points.npz",
        "observations.npz",
        "corners.npz",
    ):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_restored_map_is_the_same_map_and_can_grow(saved: SavedMap) -> None:
    map_ = restore_map(saved.snapshot)
    assert same(map_.snapshot(), saved.snapshot)
    shared = map_.neighbours(0)
    assert len(shared) > 3
    new = dataclasses.replace(saved.snapshot.keyframes()[-1], kf_id=10_000)
    row = map_.add_keyframe(new, np.eye(4))
    map_.observe(row, map_.point_rows(new.point_ids), new.uv_left, new.uv_right, new.descriptors)
    assert map_.neighbours(row)[0] == row - 1


def test_keyframes_of_a_map_observe_its_points_at_their_positions(saved: SavedMap) -> None:
    keyframe = saved.snapshot.keyframes()[5]
    error = saved.rig.left.project(keyframe.points_cam) - keyframe.uv_left
    assert np.median(np.linalg.norm(error, axis=1)) < 3.0
    assert len(keyframe.corners) == 300
    again = se3.transform(keyframe.odom_T_cam, keyframe.points_cam)
    rows = np.searchsorted(saved.snapshot.pt_ids, keyframe.point_ids)
    assert np.allclose(again, saved.snapshot.points[rows])


def spoil(folder: Path, **changes: object) -> None:
    head = json.loads((folder / "map.json").read_text())
    (folder / "map.json").write_text(json.dumps({**head, **changes}))


def test_each_error_has_its_line(tmp_path: Path, saved: SavedMap) -> None:
    with pytest.raises(StereoSfmError, match=r"there is no map\.json"):
        load_map(tmp_path / "nothing")
    folder = tmp_path / "m"
    save_map(saved, folder)
    with pytest.raises(StereoSfmError, match="cannot be used with this camera: one camera instead of two cameras"):
        load_map(folder, Rig(saved.rig.left))
    spoil(folder, version=7)
    with pytest.raises(StereoSfmError, match="version 7, this program reads version 5"):
        load_map(folder)
    (folder / "map.json").write_text("{")
    with pytest.raises(StereoSfmError, match=r"damaged: map\.json"):
        load_map(folder)


def test_maps_without_side_views_are_read(tmp_path: Path, saved: SavedMap) -> None:
    folder = tmp_path / "m"
    save_map(saved, folder)
    columns = dict(np.load(folder / "corners.npz"))
    del columns["corner_side"]
    np.savez_compressed(folder / "corners.npz", **columns)
    head = json.loads((folder / "map.json").read_text())
    head["sha256"]["corners"] = hashlib.sha256((folder / "corners.npz").read_bytes()).hexdigest()
    (folder / "map.json").write_text(json.dumps({**head, "version": 2}))
    read = load_map(folder).snapshot
    assert not read.corner_side.any() and len(read.corner_side) == len(read.corner_kf)


def test_gravity_is_saved_and_maps_without_it_are_read(tmp_path: Path, saved: SavedMap) -> None:
    folder, count = tmp_path / "m", len(saved)
    known = dataclasses.replace(
        saved.snapshot, down=np.tile([0.0, 0.6, 0.8], (count, 1)), down_sigma=np.full(count, 1e-3)
    )
    save_map(dataclasses.replace(saved, snapshot=known), folder)
    read = load_map(folder).snapshot
    np.testing.assert_array_equal(read.down, known.down)
    assert read.keyframes()[3].down_sigma == 1e-3
    columns = dict(np.load(folder / "keyframes.npz"))
    del columns["down"], columns["down_sigma"]
    np.savez_compressed(folder / "keyframes.npz", **columns)
    head = json.loads((folder / "map.json").read_text())
    head["sha256"]["keyframes"] = hashlib.sha256((folder / "keyframes.npz").read_bytes()).hexdigest()
    (folder / "map.json").write_text(json.dumps({**head, "version": 3}))
    read = load_map(folder).snapshot
    assert not read.down.any() and read.down_sigma.shape == (count,) and not read.down_sigma.any()


@pytest.mark.parametrize(
    "name", ["keyframes.npz", "points.npz", "observations.npz", "corners.npz", "rig.yaml", "cameras.yaml"]
)
@pytest.mark.parametrize("harm", ["cut", "flip", "remove"])
def test_damaged_files_are_rejected(tmp_path: Path, saved: SavedMap, name: str, harm: str) -> None:
    save_map(saved, tmp_path / "m")
    path = tmp_path / "m" / name
    raw = bytearray(path.read_bytes())
    if harm == "remove":
        path.unlink()
    elif harm == "cut":
        path.write_bytes(raw[: len(raw) // 2])
    else:
        raw[len(raw) // 2] ^= 0xFF
        path.write_bytes(raw)
    with pytest.raises(StereoSfmError, match="damaged"):
        load_map(tmp_path / "m")


def test_an_edited_focal_length_is_rejected(tmp_path: Path, saved: SavedMap) -> None:
    save_map(saved, tmp_path / "m")
    path = tmp_path / "m" / "rig.yaml"
    focal = f"{saved.rig.left.fx!r}"
    assert focal in path.read_text()
    path.write_text(path.read_text().replace(focal, f"{saved.rig.left.fx + 1!r}"))
    with pytest.raises(StereoSfmError, match="damaged: a file is missing or was changed"):
        load_map(tmp_path / "m")


@pytest.mark.parametrize("value", [None, 1.5, -1, 3, [], True])
@pytest.mark.parametrize("field", ["keyframes", "points", "observations", "sessions", "vocabulary", "sha256"])
def test_each_field_of_map_json_is_checked(tmp_path: Path, saved: SavedMap, field: str, value: object) -> None:
    save_map(saved, tmp_path / "m")
    spoil(tmp_path / "m", **{field: value})
    with pytest.raises(StereoSfmError, match=r"damaged: map\.json (has no|lacks|says)"):
        load_map(tmp_path / "m")
    head = json.loads((tmp_path / "m" / "map.json").read_text())
    del head[field]
    (tmp_path / "m" / "map.json").write_text(json.dumps(head))
    with pytest.raises(StereoSfmError, match=r"damaged: map\.json (has no|lacks)"):
        load_map(tmp_path / "m")


@pytest.mark.parametrize("other_files", [[], ["notes.txt"]])
def test_a_failed_save_keeps_the_old_map(
    tmp_path: Path, saved: SavedMap, monkeypatch: pytest.MonkeyPatch, other_files: list[str]
) -> None:
    folder = tmp_path / "m"
    save_map(saved, folder)
    for name in other_files:
        (folder / name).write_text("mine")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    other = dataclasses.replace(saved, vocabulary_id="new")
    with monkeypatch.context() as patch:
        patch.setattr("stereo_sfm.maps.saved_map.write_native", full)
        with pytest.raises(OSError, match="No space"):
            save_map(other, folder)
        with pytest.raises(OSError, match="No space"):
            save_map(other, tmp_path / "fresh")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert list(tmp_path.iterdir()) == [folder]
    save_map(other, folder)
    assert load_map(folder).vocabulary_id == "new"
    assert list(tmp_path.iterdir()) == [folder]
    assert {path.name for path in folder.iterdir()} == before.keys()


def test_a_map_can_be_saved_into_the_working_directory(
    tmp_path: Path, saved: SavedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        save_map(saved, Path())
        assert len(load_map(Path())) == len(saved)
        assert tmp_path.samefile(Path.cwd())
    (tmp_path.parent / "link").symlink_to(tmp_path)
    monkeypatch.chdir(tmp_path.parent)
    save_map(saved, tmp_path.parent / "link")
    assert (tmp_path.parent / "link").is_symlink()


def test_empty_map_is_not_saved(tmp_path: Path, saved: SavedMap) -> None:
    s = saved.snapshot
    nothing = dataclasses.replace(s, points=s.points[:0], pt_ids=s.pt_ids[:0])
    with pytest.raises(StereoSfmError, match="empty"):
        save_map(dataclasses.replace(saved, snapshot=nothing), tmp_path / "m")


def test_empty_map_is_not_loaded(tmp_path: Path, saved: SavedMap) -> None:
    """A complete folder of another program without a single point."""
    folder = tmp_path / "m"
    save_map(saved, folder)
    sums = json.loads((folder / "map.json").read_text())["sha256"]
    for name in ("keyframes", "points", "observations", "corners"):
        path = folder / f"{name}.npz"
        with np.load(path) as data:
            columns = {c: data[c] if name == "keyframes" else data[c][:0] for c in data.files}
        np.savez_compressed(path, **columns)
        sums[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    spoil(folder, sha256=sums)
    with pytest.raises(StereoSfmError, match="is empty"):
        load_map(folder)


def test_map_info_on_the_command_line(tmp_path: Path, saved: SavedMap, capsys: pytest.CaptureFixture[str]) -> None:
    save_map(saved, tmp_path / "m")
    assert main(["map", "info", str(tmp_path / "m")]) == 0
    out = capsys.readouterr().out
    assert f"{len(saved)} keyframes, {len(saved.snapshot.pt_ids)} points" in out
    assert "kannala_brandt 848x800, baseline 64.0 mm" in out
    assert main(["map", "info", str(tmp_path)]) == 2
    (tmp_path / "m").rename(tmp_path / "map")  # as in the folder of a run
    assert main(["map", "info", str(tmp_path)]) == 0
    assert "no map at" in capsys.readouterr().err
