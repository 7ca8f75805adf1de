"""Versions of a store in a bucket: nothing lost, nothing double, little to fetch, and back to the last good one."""

from __future__ import annotations

import errno
import json
import re
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard

from stereo_sfm.arrays import write_arrays
from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.fleet import copies
from stereo_sfm.fleet.copies import fetch_released, fetch_version, version_of
from stereo_sfm.fleet.editing import checked_out
from stereo_sfm.fleet.versions import (
    StoredFile,
    current,
    forget_versions,
    history,
    numbered,
    publish,
    read_head,
    release,
    released,
    roll_back,
)
from stereo_sfm.maps.store import lock
from stereo_sfm.storage import objects
from stereo_sfm.storage.objects import Changed, Unreachable
from stereo_sfm.storage.remote import Remote
from tests.fleet.s3_server import Server

ROWS = 20_000


def write_night(folder: Path, night: int) -> None:
    """A map's tables, of which a tenth of the rows are other ones each night; 1.3 MB."""
    folder.mkdir(exist_ok=True)
    rows = np.random.default_rng(0).integers(0, 256, (ROWS, 64), np.uint8)
    for k in range(1, night + 1):
        part = slice(ROWS // 10 * (k - 1), ROWS // 10 * k)
        rows[part] = np.random.default_rng(k).integers(0, 256, (ROWS // 10, 64), np.uint8)
        rows = rows[k:]  # rows before are forgotten: all others have another place
    write_arrays(folder / "observations.npz", {"descriptors": rows}, compress=False)
    (folder / "map.json").write_text(json.dumps({"night": night}))


def publish_night(store: Remote, folder: Path, night: int) -> None:
    write_night(folder, night)
    publish(store, folder, read_head(store), {f"session{night}": f"night {night}"}, [f"night {night}"], "test")


def content(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.name != copies.STATE}


def test_a_robot_fetches_what_has_changed(place: str, tmp_path: Path) -> None:
    store, made, robot = Remote.of(place), tmp_path / "made", tmp_path / "robot"
    publish_night(store, made, 0)
    first = fetch_version(store, current(store), robot)
    assert content(robot) == content(made) and first.received > 1_000_000
    publish_night(store, made, 1)
    night = fetch_version(store, current(store), robot)
    assert content(robot) == content(made) and night.received < 0.15 * first.received
    assert fetch_version(store, current(store), robot).received == 0
    for k in (2, 3, 4):
        publish_night(store, made, k)
    late = fetch_version(store, current(store), robot)  # offline for three nights
    assert content(robot) == content(made) and late.received < 0.45 * first.received
    assert version_of(robot)[1] == 5 and [v.number for v in history(store)] == [5, 4, 3, 2, 1]


def test_a_folder_of_another_store_becomes_this_one(place: str, tmp_path: Path) -> None:
    """Moved to another shop, or the store was begun anew: never the map of the one before."""
    robot = tmp_path / "robot"
    for night, name in enumerate(("here", "there")):
        publish_night(Remote.of(place) / name, tmp_path / name, night)
        fetch_released(Remote.of(place) / name, "", robot)
        assert content(robot) == content(tmp_path / name)
    with pytest.raises(StereoSfmError, match=r"no map at .*/nowhere"):
        fetch_released(Remote.of(place) / "nowhere", "", robot)
    store = Remote.of(place) / "there"
    objects.delete(store / name for name, _, _ in objects.listed(store))
    publish_night(store, tmp_path / "anew", 2)
    fetch_released(store, "", robot)
    assert content(robot) == content(tmp_path / "anew")


def test_a_map_of_no_store_is_not_replaced(place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store, mine = Remote.of(place), tmp_path / "mine"
    publish_night(store, tmp_path / "made", 0)
    write_night(mine, 1)
    before = content(mine)
    assert main(["map", "fetch", place, str(mine)]) == StereoSfmError.exit_code
    said = capsys.readouterr().err.strip()
    assert "of another map: choose another folder" in said and len(said.splitlines()) == 1
    with pytest.raises(StereoSfmError, match="of another map"):  # at the start of a service
        fetch_released(store, "", mine)
    assert content(mine) == before
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").write_text("stays")
    assert main(["map", "fetch", place, str(tmp_path / "notes")]) == 0
    assert content(tmp_path / "notes").keys() == {*content(tmp_path / "made"), "mine.txt"}


def test_two_programs_write_no_map_at_once(place: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A robot is given a map while a person fetches it."""
    store, robot = Remote.of(place), tmp_path / "robot"
    publish_night(store, tmp_path / "made", 0)
    fetch_released(store, "", robot)
    publish_night(store, tmp_path / "made", 1)
    with lock(robot):
        with pytest.raises(StereoSfmError, match="another run is writing to"):
            fetch_version(store, current(store), robot)
        fetch_released(store, "", robot)
        assert "stays version 1" in caplog.text and version_of(robot)[1] == 1
    fetch_released(store, "", robot)
    assert version_of(robot)[1] == 2


def test_a_second_writer_is_refused_and_writes_nothing(place: str, tmp_path: Path) -> None:
    store = Remote.of(place)
    publish_night(store, tmp_path / "made", 0)
    outcomes: list[str] = []

    def write(k: int) -> None:
        try:
            with checked_out(store) as out:
                (out.folder / "map.json").write_text(f"{k}")
                barrier.wait()
                out.publish({f"of {k}": f"{k}"}, [])
            outcomes.append("written")
        except Changed as error:
            outcomes.append("refused" if "run this again" in str(error) else str(error))

    for turn in range(3):
        barrier = threading.Barrier(2)
        threads = [threading.Thread(target=write, args=(2 * turn + k,)) for k in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert sorted(outcomes) == ["refused"] * 3 + ["written"] * 3
    assert len(current(store).sessions) == 4 and current(store).number == 4
    assert len([name for name, _, _ in objects.listed(store / "versions")]) == 4


def test_damage_in_the_bucket_leaves_the_robot_as_it_was(place: str, tmp_path: Path) -> None:
    store, made, robot = Remote.of(place), tmp_path / "made", tmp_path / "robot"
    publish_night(store, made, 0)
    fetch_version(store, current(store), robot)
    before = content(robot)
    publish_night(store, made, 1)
    new = current(store).files["observations.npz"]
    patch = store / new.differences
    objects.write(patch, objects.read(patch)[:-100])
    assert fetch_version(store, current(store), robot).received > 1_000_000  # the whole file instead
    assert content(robot) == content(made)
    roll_back(store)
    fetch_version(store, current(store), robot)
    assert content(robot) == before
    whole = store / new.whole
    objects.write(whole, objects.read(whole)[:-100])
    with pytest.raises(StereoSfmError, match="is damaged"):
        fetch_version(store, numbered(store, 2), robot)
    assert content(robot) == before and version_of(robot)[1] == 1


def test_a_rolled_back_session_is_not_put_in_again(place: str, tmp_path: Path) -> None:
    store = Remote.of(place)
    for night in (0, 1):
        publish_night(store, tmp_path / "made", night)
    assert roll_back(store).number == 1
    with checked_out(store) as out:
        assert out.holds("session0") == "it is in the map already"
        assert "rolled back" in out.holds("session1") and not out.holds("session2")
    publish_night(store, tmp_path / "made", 2)
    assert current(store).number == 3 and current(store).sessions.keys() == {"session0", "session2"}
    roll_back(store)
    with pytest.raises(StereoSfmError, match="no earlier version"):
        roll_back(store)


def test_robots_that_were_given_a_version_lose_it_when_it_is_rolled_back(place: str, tmp_path: Path) -> None:
    store = Remote.of(place)
    for night in (0, 1):
        publish_night(store, tmp_path / "made", night)
    release(store, 2)
    release(store, 1, ("r7",))
    release(store, 2, ("r8",))
    assert roll_back(store).number == 1
    assert [released(store, robot).number for robot in ("r1", "r7", "r8")] == [1, 1, 1]
    publish_night(store, tmp_path / "made", 2)
    assert [released(store, robot).number for robot in ("r1", "r7", "r8")] == [3, 1, 3]


def answer_lost(monkeypatch: pytest.MonkeyPatch, meanwhile: Callable[[], object]) -> None:
    """The next exchange is carried out, its answer lost; something else happens before it is tried again."""
    exchange = objects.exchange

    def lost(remote: Remote, data: bytes, tag: str | None) -> None:
        monkeypatch.setattr(objects, "exchange", exchange)
        exchange(remote, data, tag)
        meanwhile()
        exchange(remote, data, tag)

    monkeypatch.setattr(objects, "exchange", lost)


def test_a_version_whose_answer_was_lost_is_the_parent_of_the_next(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Remote.of(place)
    publish_night(store, tmp_path / "made", 0)
    answer_lost(monkeypatch, lambda: publish_night(store, tmp_path / "other", 2))
    publish_night(store, tmp_path / "made", 1)
    assert [v.number for v in history(store)] == [3, 2, 1]
    assert current(store).sessions.keys() == {"session0", "session1", "session2"}
    fetch_version(store, numbered(store, 2), tmp_path / "robot")
    assert content(tmp_path / "robot") == content(tmp_path / "made")
    assert roll_back(store).number == 2


def test_a_rollback_whose_answer_was_lost_is_not_done_twice(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Remote.of(place)
    for night in (0, 1):
        publish_night(store, tmp_path / "made", night)
    answer_lost(monkeypatch, lambda: publish_night(store, tmp_path / "other", 2))
    assert roll_back(store).number == 1 and [v.number for v in history(store)] == [3, 1]


def test_a_rollback_that_is_killed_has_reached_the_robots(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after its first write."""
    store, exchange = Remote.of(place), objects.exchange
    for night in (0, 1):
        publish_night(store, tmp_path / "made", night)
    release(store, 1)
    release(store, 2, ("r7",))

    def killed(remote: Remote, data: bytes, tag: str | None) -> None:
        exchange(remote, data, tag)
        raise KeyboardInterrupt

    monkeypatch.setattr(objects, "exchange", killed)
    with pytest.raises(KeyboardInterrupt):
        roll_back(store)
    monkeypatch.setattr(objects, "exchange", exchange)
    assert current(store).number == released(store, "r7").number == 1
    with pytest.raises(StereoSfmError, match=r"version 2 of .* was rolled back"):
        release(store, 2, ("r8",))
    publish_night(store, tmp_path / "made", 2)
    release(store, 3, ("r8",))
    assert [released(store, robot).number for robot in ("r1", "r7", "r8")] == [1, 1, 3]


@pytest.mark.parametrize("name", ["../out", "/tmp/out", "a/b", "..", ""])
def test_a_version_names_no_file_outside(name: str, place: str, tmp_path: Path) -> None:
    store = Remote.of(place)
    publish_night(store, tmp_path / "made", 0)
    manifest = store / current(store).name
    data = json.loads(objects.read(manifest))
    data["files"][name] = next(iter(data["files"].values()))
    objects.write(manifest, json.dumps(data).encode())
    with pytest.raises(StereoSfmError, match="is damaged, or is no store"):
        current(store)


def test_a_version_is_released_to_some_robots_first(place: str, tmp_path: Path) -> None:
    store = Remote.of(place)
    for night in (0, 1, 2):
        publish_night(store, tmp_path / "made", night)
    assert released(store, "r1").number == 3
    release(store, 1)
    release(store, 3, ("r7", "r8"))
    assert [released(store, robot).number for robot in ("r1", "r7", "r8", "")] == [1, 3, 3, 1]
    release(store, 2)
    assert released(store, "r7").number == 2  # all robots means all
    with pytest.raises(StereoSfmError, match="has no version 9"):
        release(store, 9)


def test_old_versions_lose_their_files_and_nothing_else(place: str, tmp_path: Path) -> None:
    store, made, late = Remote.of(place), tmp_path / "made", tmp_path / "late"
    wanted: dict[int, dict[str, bytes]] = {}
    for night in range(6):
        publish_night(store, made, night)
        wanted[night + 1] = content(made)
        if night == 1:
            fetch_version(store, current(store), late)
    release(store, 2, ("r7",))
    began = read_head(store)
    assert forget_versions(store, 7) == 0
    assert forget_versions(store, 3) > 1_000_000 and forget_versions(store, 3) == 0
    for number in (2, 4, 5, 6):  # the last three, and a robot's
        fetch_version(store, numbered(store, number), tmp_path / f"v{number}")
        assert content(tmp_path / f"v{number}") == wanted[number]
    fetch_version(store, current(store), late)  # three nights behind: the differences are there no more
    assert content(late) == wanted[6]
    with pytest.raises(StereoSfmError, match="there is no"):
        fetch_version(store, numbered(store, 3), tmp_path / "v3")
    with pytest.raises(StereoSfmError, match="were deleted"):
        release(store, 3)
    with pytest.raises(Changed):  # a program that began before
        publish(store, made, began, {}, [], "test")
    assert [v.number for v in history(store)] == [6, 5, 4, 3, 2, 1]
    assert [roll_back(store).number for _ in range(2)] == [5, 4]
    with pytest.raises(StereoSfmError, match="no earlier version"):
        roll_back(store)
    fetch_version(store, numbered(store, 6), late)  # rolled back, and younger than the oldest one that is kept
    assert content(late) == wanted[6]


def test_a_store_of_before_has_one_folder_of_files(place: str, tmp_path: Path) -> None:
    """Its versions are read, followed by new ones, and forgotten."""
    store, made = Remote.of(place), tmp_path / "made"
    for night in (0, 1):
        publish_night(store, made, night)
        version = current(store)
        data = json.loads(objects.read(store / version.name))
        for name, file in version.files.items():
            at = data["files"][name].pop("at")
            if at in version.name:
                before = StoredFile(**data["files"][name])
                objects.write(store / before.whole, objects.read(store / file.whole))
                if file.patched:
                    objects.write(store / before.differences, objects.read(store / file.differences))
        objects.write(store / version.name, json.dumps(data).encode())
        objects.delete(store / name for name, _, _ in objects.listed(store) if re.match("(files|patches)/.*/", name))
    fetch_version(store, numbered(store, 1), tmp_path / "robot")
    assert 0 < fetch_version(store, current(store), tmp_path / "robot").received < 300_000
    assert content(tmp_path / "robot") == content(made)
    publish_night(store, made, 2)
    assert fetch_version(store, current(store), tmp_path / "robot").received < 300_000
    assert forget_versions(store, 1) > 1_000_000
    fetch_version(store, current(store), tmp_path / "other")
    assert content(tmp_path / "other") == content(tmp_path / "robot") == content(made)


def test_without_a_network_a_robot_keeps_its_version(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    publish_night(Remote.of(place), tmp_path / "made", 0)
    assert main(["map", "fetch", place, str(tmp_path / "robot")]) == 0
    before = content(tmp_path / "robot")

    def away(remote: Remote) -> None:
        raise Unreachable(f"cannot read {remote}: no answer after 12 tries")

    monkeypatch.setattr(objects, "read_tagged", away)
    assert main(["map", "fetch", place, str(tmp_path / "robot")]) == 0
    assert "stays version 1" in capsys.readouterr().err and content(tmp_path / "robot") == before
    assert main(["map", "fetch", place, str(tmp_path / "other")]) == StereoSfmError.exit_code


@pytest.mark.parametrize("full", ["disk", "memory"])
def test_without_room_a_robot_keeps_its_version(
    full: str, place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    store, robot = Remote.of(place), tmp_path / "robot"
    publish_night(store, tmp_path / "made", 0)
    fetch_released(store, "", robot)
    before = content(robot)
    publish_night(store, tmp_path / "made", 1)

    def no_room(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device") if full == "disk" else MemoryError

    monkeypatch.setattr(*((Path, "write_bytes") if full == "disk" else (zstandard, "ZstdDecompressor")), no_room)
    with pytest.raises(OSError if full == "disk" else MemoryError):  # nothing is damaged
        fetch_released(store, "", tmp_path / "other")
    fetch_released(store, "", robot)
    assert "stays version 1" in caplog.text and content(robot) == before


def test_without_a_network_a_map_is_read_as_it_was_fetched_last(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    store = Remote.of(place)
    publish_night(store, tmp_path / "made", 0)
    assert content(copies.fetched(store)) == content(tmp_path / "made")

    def away(remote: Remote) -> None:
        raise Unreachable(f"cannot read {remote}: no answer after 12 tries")

    for name in ("read_tagged", "exists"):
        monkeypatch.setattr(objects, name, away)
    assert content(copies.fetched(store)) == content(tmp_path / "made") and "stays version 1" in caplog.text
    with pytest.raises(Unreachable):
        copies.fetched(store / "other")


def test_what_is_no_store_is_one_line(place: str, s3: Server) -> None:
    with pytest.raises(StereoSfmError, match="no map at"):
        current(Remote.of(place))
    objects.write(Remote.of(place) / "head.json", b"{}")
    with pytest.raises(StereoSfmError, match="is no store"):
        read_head(Remote.of(place))
