"""gs:// and az:// do what s3:// does: versions with one writer, files by ranges, folders, messages of one line."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.fleet.versions import current, history, roll_back
from stereo_sfm.maps.saved_map import save_map
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import fetch, send_folder
from stereo_sfm.storage.objects import Missing
from stereo_sfm.storage.remote import Remote
from tests.fleet import azurite, gs_server
from tests.fleet.writers import winners
from tests.maps.maps import small_map


@pytest.fixture(scope="module", params=["gs", "az"])
def cloud(request: pytest.FixtureRequest) -> Iterator[Remote]:
    """A place in a bucket of a server on this computer."""
    pytest.importorskip("obstore")
    with pytest.MonkeyPatch.context() as patch:
        program = shutil.which("azurite-blob")
        if request.param == "az" and program is None:
            pytest.skip("azurite is not installed")
        with gs_server.server() if request.param == "gs" else azurite.server(program or "") as url:
            patch.setenv(objects.EMULATOR, url)
            patch.setenv("AZURE_STORAGE_USE_EMULATOR", "true")
            patch.setenv("AZURITE_BLOB_STORAGE_URL", url)
            objects._store.cache_clear()  # pyright: ignore[reportPrivateUsage]
            yield Remote.of(f"{request.param}://{gs_server.BUCKET}")
    objects._store.cache_clear()  # pyright: ignore[reportPrivateUsage]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STEREO_SFM_CACHE", str(tmp_path / "cache"))


def test_one_of_many_writers_wins(cloud: Remote) -> None:
    target, tag = cloud / "head", None
    for turn in range(3):
        won = winners(target, turn, tag, 8)
        raw, tag = objects.read_tagged(target)
        assert len(won) == 1 and raw == f"{turn} {won[0]}".encode()


def test_folders_and_messages(cloud: Remote, tmp_path: Path) -> None:
    (tmp_path / "f" / "sub").mkdir(parents=True)
    (tmp_path / "f" / "sub" / "a").write_bytes(b"0123456789")
    target = cloud / "folder"
    assert send_folder(tmp_path / "f", target) == 10 and send_folder(tmp_path / "f", target) == 0
    assert (fetch(target) / "sub" / "a").read_bytes() == b"0123456789"
    assert objects.read_range(target / "sub/a", 3, 4) == b"3456" and objects.folders(target) == ["sub"]
    objects.delete([target / "sub/a"])
    with pytest.raises(Missing, match="there is no"):
        objects.read(target / "sub/a")
    with pytest.raises(StereoSfmError, match="there is no bucket"):
        objects.listed(Remote.of(f"{cloud.scheme}://absent/x"))


def test_a_store_has_versions(cloud: Remote, tmp_path: Path) -> None:
    save_map(small_map()[1], tmp_path / "map")
    store = cloud / "store"
    assert main(["map", "update", str(store), str(tmp_path / "map")]) == 0
    first = current(store)
    assert main(["map", "fetch", str(store), str(tmp_path / "robot")]) == 0
    assert main(["map", "release", str(store), "1"]) == 0
    assert (tmp_path / "robot" / "map.json").is_file() and [v.number for v in history(store)] == [1]
    with pytest.raises(StereoSfmError, match="no earlier version"):
        roll_back(store)
    assert current(store) == first
