"""A robot whose key has the rights of its store's prefix alone: S3 denies it what is missing, too."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.fleet.copies import fetch_released, version_of
from stereo_sfm.fleet.versions import publish, read_head, release, released
from stereo_sfm.recording.segments import Segment, new_recording, sent_whole
from stereo_sfm.recording.upload import Uploader
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import fetch, send_folder
from stereo_sfm.storage.remote import Remote
from tests.fleet.s3_server import KEY, LIMITED, Server


@pytest.fixture
def robot(place: str, s3: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Stores `a` and `b` with a version each, and a key of `a` alone."""
    for store in ("a", "b"):
        publish_files(Remote.of(place) / store / "map", tmp_path / "made", b"1")
    use(monkeypatch, f"{LIMITED}{Remote.of(place).key}.a")
    return monkeypatch


def publish_files(store: Remote, folder: Path, data: bytes) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "map.json").write_bytes(data)
    publish(store, folder, read_head(store), {data.hex(): "a walk"}, [], "test")


def use(monkeypatch: pytest.MonkeyPatch, key: str) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", key)
    objects._store.cache_clear()  # pyright: ignore[reportPrivateUsage]


def test_it_fetches_its_map_and_what_it_was_given(place: str, robot: pytest.MonkeyPatch, tmp_path: Path) -> None:
    store, here = Remote.of(place) / "a" / "map", tmp_path / "robot"
    fetch_released(store, "r1", here)  # nothing was released: that object is missing
    assert version_of(here)[1] == 1
    use(robot, KEY)
    publish_files(store, tmp_path / "made", b"2")
    release(store, 1)
    release(store, 2, ("r1",))
    use(robot, f"{LIMITED}{Remote.of(place).key}.a")
    assert released(store, "r1").number == 2 and released(store, "r2").number == 1
    assert main(["map", "fetch", str(store), str(here), "--robot", "r1"]) == 0
    assert (here / "map.json").read_bytes() == b"2"


def test_it_sends_its_recordings_and_maps(place: str, robot: pytest.MonkeyPatch, tmp_path: Path) -> None:
    walks = Remote.of(place) / "a" / "walks" / "r1"
    segment = Segment.of(new_recording(tmp_path / "records", "sim:aisle", "full", datetime(2026, 11, 25, 22)), 0, 0)
    segment.poses.write_bytes(b"p" * 10)
    segment.images.write_bytes(bytes(12 << 20))  # is sent in parts
    assert Uploader(tmp_path / "records", walks).send_all() == 2 and sent_whole(segment.folder)
    assert main(["record", "sim:aisle?size=96x80&frames=3", "-o", f"{walks}/2026-11-26.mcap", "-q"]) == 0
    assert [send_folder(tmp_path / "made", walks / "2026-11-27") for _ in range(2)] == [1, 0]
    assert (fetch(walks / "2026-11-27") / "map.json").read_bytes() == b"1"


def test_it_has_no_right_to_another_store(place: str, robot: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "y").write_bytes(b"1")
    with pytest.raises(StereoSfmError, match="no right to read"):
        fetch_released(Remote.of(place) / "b" / "map", "r1", tmp_path / "robot")
    with pytest.raises(StereoSfmError, match="no right to read"):
        send_folder(tmp_path / "x", Remote.of(place) / "b" / "walks")
    with pytest.raises(StereoSfmError, match="no right to write"):
        objects.write(Remote.of(place) / "b" / "x", b"1")
