"""A run that began with a saved map is replayed with that map, and with no other."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.commands.replay import map_folders
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log.provenance import Opening, write_provenance
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.recorded import read_opening
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.maps.folders import MapFolders, map_sha256


def logged(tmp_path: Path, opening: Opening) -> Opening:
    path = tmp_path / "run.mcap"
    writer = LogWriter(path)
    write_provenance(writer, source="s", serial="", mode="inline", image_format="none", opening=opening)
    writer.close()
    with LogReader(path) as reader:
        return read_opening(reader)


@pytest.mark.parametrize("localize_only", [False, True])
def test_the_log_names_the_map(tmp_path: Path, localize_only: bool, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "store"
    store.mkdir()
    (store / "map.json").write_text("{}")
    opening = logged(tmp_path, Opening(map_in=str(store), map_sha256=map_sha256(store), localize_only=localize_only))
    assert map_folders(opening) == MapFolders(store, localize_only)
    assert main(["export", str(tmp_path), "--format", "g2o"]) == 2
    assert f"holds no map of its own: it used {store} (--map-in), export that one" in capsys.readouterr().err
    (store / "map.json").write_text("{ }")
    with pytest.raises(StereoSfmError, match="has changed since"):
        map_folders(opening)
    (store / "map.json").unlink()
    with pytest.raises(StereoSfmError, match="missing or has changed"):
        map_folders(opening)


def test_a_run_without_a_map_has_none(tmp_path: Path) -> None:
    assert map_folders(logged(tmp_path, Opening())) == MapFolders()
