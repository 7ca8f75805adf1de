"""A folder by its other names: `.`, `..`, a link. Every command finds the same folder, and what is beside it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps.saved_map import save_map
from stereo_sfm.maps.store import lock
from stereo_sfm.service.config import MapConfig, load
from stereo_sfm.service.map_keeper import MapKeeper
from stereo_sfm.storage.remote import place
from tests.maps.maps import small_map


@pytest.fixture(scope="module")
def a_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps") / "store"
    save_map(small_map()[1], folder)
    return folder


@pytest.fixture(params=[".", "..", "../../link"])
def name(request: pytest.FixtureRequest, a_map: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The store `tmp_path / "place" / "store"` by another name, from the working directory."""
    store = shutil.copytree(a_map, tmp_path / "place" / "store")
    (store / "inside").mkdir()
    (tmp_path / "link").symlink_to(store)
    monkeypatch.chdir(store / "inside" if request.param == ".." else store)
    return str(request.param)


@pytest.mark.parametrize(
    "command",
    [
        ["map", "info", "STORE"],
        ["map", "versions", "STORE"],
        ["map", "label", "STORE", "aisle 4", "1,2", "3,4"],
        ["map", "plan", "STORE"],
        ["map", "export", "STORE", "--format", "floor-plan", "-o", "STORE"],
        ["map", "export", "STORE", "--format", "tum", "-o", "STORE"],
        ["map", "export", "STORE", "--format", "ply", "-o", "STORE"],
    ],
)
def test_the_folder_is_the_store(command: list[str], name: str, tmp_path: Path) -> None:
    assert main([name if word == "STORE" else word for word in command]) == 0
    beside = {path.name for path in (tmp_path / "place").iterdir()} | {path.name for path in tmp_path.iterdir()}
    assert beside <= {"place", "link", "store", "store.versions"}


@pytest.mark.parametrize("action", [["update", "STORE", "SESSION"], ["undo", "STORE"]])
def test_versions_are_beside_the_folder_itself(
    action: list[str], name: str, a_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = {"STORE": name, "SESSION": str(a_map)}
    assert main(["map", *(words.get(word, word) for word in action)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "this session is in the map already" in line or f"no earlier version of {name} is kept" in line
    assert (tmp_path / "place" / "store.versions").is_dir()


def test_two_names_of_a_store_have_one_lock(name: str, tmp_path: Path) -> None:
    with lock(tmp_path / "place" / "store"), pytest.raises(StereoSfmError, match="another run is writing"):
        lock(Path(name))


def test_the_service_keeps_its_parts_beside_the_folder_itself(name: str, tmp_path: Path) -> None:
    keeper = MapKeeper(MapConfig(name), Config())
    assert keeper.begin().map_in == tmp_path / "place" / ".store.base"
    assert keeper.beside("b") == tmp_path / "place" / "b"


@pytest.mark.parametrize("text", ["", "/", "//"])
def test_a_service_needs_a_folder_with_a_name(text: str) -> None:
    with pytest.raises(StereoSfmError, match=f"^map.folder is '{text}': name a folder"):
        load(None, [f"map.folder={text}"])


def test_an_empty_store_is_no_folder(capsys: pytest.CaptureFixture[str]) -> None:
    for action in (["versions"], ["undo"], ["plan"], ["label"], ["update"]):
        rest = {"label": ["a"], "update": ["x"]}.get(action[0], [])
        assert main(["map", *action, "", *rest]) == 2
        assert "an empty text names no folder" in capsys.readouterr().err
    assert place(".") == Path()


@pytest.mark.parametrize("table", [".", "..", "x/.."])
def test_a_table_that_is_a_folder(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["eval", "a.tum", "--ref", "a.tum", "--table", table]) == 2
    assert f"--table {table} is a folder" in capsys.readouterr().err
