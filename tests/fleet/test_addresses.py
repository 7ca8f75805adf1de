"""Commands take addresses where they take paths: what they do there, and what they refuse in one line."""

# pyright: reportPrivateUsage=false

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from stereo_sfm.calib.formats import save_rig
from stereo_sfm.cli import COMMANDS, _build_parser, main
from stereo_sfm.commands.eval import load_reference
from stereo_sfm.config import Config
from stereo_sfm.drivers.source import open_source
from stereo_sfm.fleet.editing import checked_out, session_id
from stereo_sfm.fleet.versions import current, released
from stereo_sfm.log.provenance import Opening
from stereo_sfm.maps.put_session import put_session
from stereo_sfm.maps.saved_map import load_map, save_map
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import send_folder
from stereo_sfm.storage.remote import Remote
from tests.maps.maps import small_map


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    save_map(small_map()[1], tmp_path / "map")
    return tmp_path / "map"


def test_no_command_takes_the_name_of_another_option() -> None:
    """`map release STORE VERSION` once printed the versions of the program."""
    for command in COMMANDS:
        parser = _build_parser(command)
        general = {action.dest for action in parser._actions} - {"help"}
        ways = [_choices(parser)[command]]
        for way in ways:
            assert not general & {action.dest for action in way._actions}, command
            ways += _choices(way).values()


def _choices(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The commands below a parser."""
    below = [a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    return dict(*below)


def test_a_version_is_released_to_a_robot(saved: Path, place: str, tmp_path: Path) -> None:
    save_map(small_map(noise_px=0.21)[1], tmp_path / "other")
    assert main(["map", "update", place, str(saved)]) == main(["map", "update", place, str(tmp_path / "other")]) == 0
    assert main(["map", "release", place, "1", "--robots", "r1"]) == 0
    store = Remote.of(place)
    assert (released(store, "r1").number, released(store, "r2").number, current(store).number) == (1, 2, 2)


def test_a_folder_by_its_address(saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "info", f"file://{saved}"]) == 0
    assert main(["map", "prune", f"file://{saved}", "-o", f"file://{tmp_path}/pruned"]) == 0
    assert (tmp_path / "pruned" / "map.json").is_file()
    assert main(["map", "info", "gcs://bucket/map"]) == 2
    assert main(["map", "prune", str(saved), "-o", "gcs://bucket/map"]) == 2
    assert capsys.readouterr().err.count("unknown scheme 'gcs://'") == 2


def test_a_store_with_versions_in_a_folder(saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = Remote.of(f"file://{tmp_path}/chain/a/map")
    save_map(small_map(noise_px=0.21)[1], tmp_path / "other")
    with checked_out(store, begin=True) as out:
        session = load_map(saved)
        put_session(out.folder, session, "first", Config(), compress=False)
        out.publish({session_id(session): "first"}, ["the first session"])
    for name in (str(tmp_path / "chain" / "a" / "map"), str(store)):
        assert main(["map", "versions", name]) == 0
        assert "version 1: 1 sessions" in capsys.readouterr().out
    assert main(["map", "update", str(store), str(tmp_path / "other")]) == 0
    assert current(store).number == 2
    assert main(["map", "undo", str(store)]) == 0 and current(store).number == 1


def test_a_session_from_another_store(saved: Path, place: str, tmp_path: Path) -> None:
    assert main(["map", "update", place, str(saved)]) == 0
    assert main(["map", "update", str(tmp_path / "mine"), place]) == 0
    assert (tmp_path / "mine" / "map.json").is_file()


def test_truth_and_export_by_address(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    lines = [f"{k * 0.1:.1f} {0.1 * k} {0.01 * k * k} 0 0 0 0 1" for k in range(20)]
    run.mkdir()
    (run / "trajectory_map.tum").write_text("\n".join(lines) + "\n")
    send_folder(run, Remote.of(place) / "run")
    truth = f"{place}/truth.tum"
    objects.write(Remote.of(truth), (run / "trajectory_map.tum").read_bytes())
    assert main(["eval", str(run / "trajectory_map.tum"), "--ref", truth]) == 0
    assert main(["eval", str(run / "trajectory_map.tum"), "--ref", f"file://{run}/trajectory_map.tum"]) == 0
    monkeypatch.chdir(tmp_path)
    assert main(["export", f"{place}/run", "--format", "kitti"]) == 0
    assert (tmp_path / "export_map.kitti").is_file()


def test_truth_of_a_source_by_its_address_and_options(place: str, tmp_path: Path) -> None:
    walk, rig = tmp_path / "walk.mcap", tmp_path / "rig.yaml"
    assert main(["record", "sim:loop?frames=5", "-o", str(walk), "-q"]) == 0
    with open_source(str(walk)) as source:
        save_rig(source.rig, rig)
    objects.write(Remote.of(f"{place}/walk.mcap"), walk.read_bytes())
    for source in (f"{place}/walk.mcap", f"{place}/walk.mcap?rig={rig}", f"file://{walk}?rig={rig}"):
        truth, file = load_reference(source, Opening())
        assert file is None and len(truth) == 5


@pytest.mark.parametrize("source", ["s3://KEY:SECRET@b/x.mcap", "mcap:s3://KEY:SECRET@b/x.mcap"])
def test_credentials_in_an_address_are_kept_nowhere(
    source: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["batch", source, "-o", str(tmp_path / "out")]) == 2
    assert main(["eval", "s3://b/run?sig=SECRET"]) == 2
    assert "SECRET" not in capsys.readouterr().err and not (tmp_path / "out").exists()
