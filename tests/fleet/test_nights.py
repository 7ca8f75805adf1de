"""Nights in which something is odd: each store, each walk and each limit counts for itself."""

from __future__ import annotations

import dataclasses
import datetime
import json
import urllib.parse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import stereo_sfm
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.fleet import steps
from stereo_sfm.fleet.catalogue import TERMS, ask, opened
from stereo_sfm.fleet.plan import Plan, Walk, find_walks, night_of
from stereo_sfm.fleet.report import report
from stereo_sfm.fleet.run import forget_images
from stereo_sfm.fleet.steps import RESULT, map_walk, session_id
from stereo_sfm.fleet.versions import current, roll_back
from stereo_sfm.jobs import Result
from stereo_sfm.maps.saved_map import load_map, save_map
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import fetch_into, send_folder
from stereo_sfm.storage.remote import Remote
from tests.fleet.nights import STORE, carry_out, walks
from tests.fleet.s3_server import BUCKET, READER, Server
from tests.maps.maps import small_map

NIGHT = "2026-11-25"
TODAY = datetime.datetime.now(datetime.UTC).date()  # of the server, which dates what is written
OLD = TODAY - datetime.timedelta(40)
Mapped = Callable[[Walk, Config, Path], Result]


@pytest.fixture
def others(tmp_path: Path) -> list[Path]:
    """Further maps of the same aisle."""
    folders = [tmp_path / f"other{k}" for k in range(2)]
    for folder, noise in zip(folders, (0.21, 0.22), strict=True):
        save_map(small_map(noise_px=noise)[1], folder)
    return folders


def put_object(s3: Server, remote: Remote, key: str) -> None:
    """An empty object of another program, whatever its key."""
    s3.request("PUT", f"/{BUCKET}/{urllib.parse.quote(f'{remote.key}/{key}')}")


def mapped_as(monkeypatch: pytest.MonkeyPatch, made: dict[str, Path | Exception]) -> None:
    """What a program maps, by robot: the map of a folder, or an error."""

    def mapped(walk: Walk, config: Config, folder: Path) -> Result:
        found = made[walk.robot]
        if isinstance(found, Exception):
            raise found
        session = load_map(found)
        save_map(session, folder / "map", compress=False)
        about = steps._about(session, session_id(session))  # pyright: ignore[reportPrivateUsage]
        return about | {"ok": True, "map": str(folder / "map"), "stats": None}

    monkeypatch.setattr(steps, "_mapped", mapped)


def rows(plan: Plan, query: str) -> list[str]:
    with opened(plan.root, [STORE]) as connection:
        return ask(connection, query)[1:]


# -- stores and names --------------------------------------------------------------------------------------------


def test_a_store_that_cannot_be_listed_stops_no_other(plan: Plan, session: Path, s3: Server) -> None:
    send_folder(session, walks(plan) / "r1" / f"{NIGHT}_2200")
    put_object(s3, plan.root, f"odd/walks/r1//{NIGHT}.mcap")
    found, _ = find_walks(plan)
    results = carry_out(plan)
    assert not results["odd"]["ok"] and "give it another name" in results["odd"]["error"]
    assert results[f"{STORE} {NIGHT}"]["version"] == 1
    assert forget_images(plan, found, datetime.date(2027, 1, 1)) > 0  # of the other one


def test_a_store_that_is_named_twice_is_one(plan: Plan, session: Path) -> None:
    send_folder(session, walks(plan) / "r1" / f"{NIGHT}_2200")
    twice = dataclasses.replace(plan, fleet=dataclasses.replace(plan.fleet, stores=f"{STORE}, {STORE}"))
    assert len(find_walks(twice)[0]) == 1


def test_no_store_that_can_be_listed_is_one_line(plan: Plan, s3: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    put_object(s3, plan.root, f"odd/walks/r1//{NIGHT}.mcap")
    with pytest.raises(StereoSfmError, match="give it another name"):
        find_walks(plan)


def test_what_arrives_late_or_has_an_odd_name_is_not_deleted(plan: Plan, s3: Server) -> None:
    """A robot was away for months; its folder is no whole walk yet."""
    late = walks(plan) / "r1" / "2025-01-05_2200"
    objects.write(late / "segment.mcap", b"images")
    objects.write(walks(plan) / "r1" / "what?.txt", b"a question")
    _, waiting = find_walks(plan)
    assert len(waiting) == 2 and forget_images(plan, [], datetime.date.today(), waiting) == 0
    assert objects.exists(late / "segment.mcap")
    assert forget_images(plan, [], datetime.date(2099, 1, 1), waiting) == 16


def test_a_marker_of_a_folder_hides_no_walk(plan: Plan, session: Path, s3: Server) -> None:
    send_folder(session, walks(plan) / "r1" / f"{NIGHT}_2200")
    for key in ("", "r1/", f"r1/{NIGHT}_2200/", "r2/"):  # the last one is an empty folder
        put_object(s3, walks(plan), key)
    found, waiting = find_walks(plan)
    assert [walk.name for walk in found] == [f"r1/{NIGHT}_2200"] and not waiting
    assert carry_out(plan)[f"{STORE} {NIGHT}"]["version"] == 1


@pytest.mark.parametrize("name", [f"r1/{NIGHT}.bag", f"r1/{NIGHT}.MCAP", f"{NIGHT}.mcap", "r1/notes.txt"])
def test_what_is_no_walk_is_named_and_deleted_by_its_age(plan: Plan, name: str) -> None:
    objects.write(walks(plan) / name, b"people")
    found, waiting = find_walks(plan)
    assert not found and waiting == [str(walks(plan) / name)]
    assert forget_images(plan, [], TODAY, waiting) == 0
    assert forget_images(plan, [], TODAY + datetime.timedelta(400), waiting) == 6
    assert find_walks(plan) == ([], [])


@pytest.mark.parametrize("name", ["rosbag2_2026_11_25-22_00_00", "2026-11-25-22-00-00", "00007_2026-11-25_220000"])
def test_names_that_ros_gives_have_a_date(name: str) -> None:
    assert night_of(name) == NIGHT


# -- images ------------------------------------------------------------------------------------------------------


def test_images_go_by_their_own_walk(plan: Plan, session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One walk of a night exceeds its time, every night: its images have 30 days from the first try."""
    for robot in ("r1", "r2"):
        objects.write(walks(plan) / robot / f"{OLD}_2200.mcap", b"people")
    mapped_as(monkeypatch, {"r1": session, "r2": TimeoutError()})
    for _ in range(2):
        assert "more than 60 minutes" in str(carry_out(plan, kept=True)[f"{STORE} {OLD}"]["failed"])
    assert forget_images(plan, find_walks(plan)[0], TODAY - datetime.timedelta(20)) == 0
    assert forget_images(plan, find_walks(plan)[0], TODAY) > 6
    assert [walk.robot for walk in find_walks(plan)[0]] == ["r2"]
    assert "r2" in str(carry_out(plan, kept=True)[f"{STORE} {OLD}"]["failed"])
    assert forget_images(plan, find_walks(plan)[0], TODAY + datetime.timedelta(40)) == 6
    assert find_walks(plan) == ([], [])
    why = rows(plan, "SELECT ok, version, why FROM walks ORDER BY robot")
    assert why == ["True,1,", "False,,it took more than 60 minutes; its recording was deleted after 30 days"]


def test_a_store_that_cannot_be_written_keeps_no_images(plan: Plan, session: Path) -> None:
    """Its map is damaged, so that none of its nights ends."""
    send_folder(session, walks(plan) / "r1" / f"{OLD}_2200")
    objects.write(plan.root / STORE / "map" / "head.json", b"no head")
    assert "damaged" in carry_out(plan, kept=True)[f"{STORE} {OLD}"]["error"]
    with pytest.raises(StereoSfmError, match="damaged"):
        forget_images(plan, find_walks(plan)[0], TODAY + datetime.timedelta(40))
    assert find_walks(plan) == ([], [])


def test_what_is_sent_again_is_mapped_before_it_is_deleted(
    plan: Plan, session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, later = walks(plan) / "r1" / f"{NIGHT}_2200.mcap", TODAY + datetime.timedelta(400)
    objects.write(recording, b"cut off")
    assert carry_out(plan)[f"{STORE} {NIGHT}"]["failed"]
    objects.write(recording, b"whole")
    assert forget_images(plan, find_walks(plan)[0], later) == 0
    mapped_as(monkeypatch, {"r1": session})
    assert not carry_out(plan)[f"{STORE} {NIGHT}"]["failed"]
    assert forget_images(plan, find_walks(plan)[0], later) > 5


def test_the_work_of_old_walks_is_deleted_and_not_repeated(plan: Plan, session: Path, others: list[Path]) -> None:
    send_folder(session, walks(plan) / "r1" / f"{OLD}_2200")
    carry_out(plan)
    late = f"{OLD + datetime.timedelta(1)}"
    send_folder(others[0], walks(plan) / "r2" / f"{late}_2200")
    carry_out(plan, only=2)  # killed before its map is in a version

    def maps() -> set[str]:
        names = [name for name, _, _ in objects.listed(plan.root / STORE / "work") if "/map/" in name]
        return {name[: len(late)] for name in names}

    found, _ = find_walks(plan)
    assert forget_images(plan, found, TODAY - datetime.timedelta(20)) == 0 and maps() == {f"{OLD}", late}
    assert forget_images(plan, found, TODAY) > 0 and maps() == {late}
    send_folder(session, walks(plan) / "r1" / f"{OLD}_2200")  # once more
    results = carry_out(plan)
    assert [name for name, result in results.items() if not result.get("resumed")] == [f"{STORE} {late}"]
    assert current(plan.root / STORE / "map").number == 2 and maps() == {late}


def test_a_walk_is_in_a_map_once_whatever_program_maps_it(
    plan: Plan, others: list[Path], session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = plan.root / STORE / "map"
    for robot, night in (("r1", NIGHT), ("r2", "2026-11-26")):
        objects.write(walks(plan) / robot / f"{night}_2200.mcap", b"a recording")
    mapped_as(monkeypatch, {"r1": session, "r2": others[0]})
    carry_out(plan)
    assert len(current(place).sessions) == 2
    assert roll_back(place).number == 1
    mapped_as(monkeypatch, {"r1": others[1], "r2": others[1]})
    monkeypatch.setattr(stereo_sfm, "__version__", "99.0.0")
    assert all(result["resumed"] for result in carry_out(plan).values())
    for name, _, _ in objects.listed(plan.root / STORE / "work"):
        if name.endswith(RESULT):
            objects.delete([plan.root / STORE / "work" / name])
    carry_out(plan)
    assert len(current(place).sessions) == 1 and current(place).number == 1


def test_a_failure_is_tried_again_by_another_program(
    plan: Plan, session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    objects.write(walks(plan) / "r1" / f"{NIGHT}_2200.mcap", b"no recording")
    assert carry_out(plan)[f"{STORE} {NIGHT}"]["failed"]
    assert all(result["resumed"] for result in carry_out(plan).values())
    mapped_as(monkeypatch, {"r1": session})
    monkeypatch.setattr(stereo_sfm, "__version__", "99.0.0")
    night = carry_out(plan)[f"{STORE} {NIGHT}"]
    assert night["version"] == 1 and not night["failed"]


# -- failures ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error", [objects.Refused("no right to read"), objects.Missing("there is no"), objects.Unreachable("no answer")]
)
def test_a_failure_of_the_storage_does_not_last(
    plan: Plan, session: Path, monkeypatch: pytest.MonkeyPatch, error: StereoSfmError
) -> None:
    send_folder(session, walks(plan) / "r1" / f"{NIGHT}_2200")

    def refused(remote: Remote, target: Path) -> None:
        raise error

    monkeypatch.setattr(steps, "fetch_into", refused)
    assert carry_out(plan)[f"{STORE} {NIGHT}"]["failed"] == {f"r1/{NIGHT}_2200": str(error)}
    monkeypatch.setattr(steps, "fetch_into", fetch_into)
    night = carry_out(plan)[f"{STORE} {NIGHT}"]
    assert night["version"] == 1 and not night["failed"]


def test_a_right_that_is_missing_is_told_from_a_damaged_walk(
    plan: Plan, s3: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in s3.environment(READER).items():
        monkeypatch.setenv(name, value)
    objects._store.cache_clear()  # pyright: ignore[reportPrivateUsage]
    with pytest.raises(objects.Refused, match="no right to write"):
        objects.write(walks(plan) / "x", b"1")


def test_a_full_disk_does_not_last(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does any other error of a run that says nothing of its recording."""
    from stereo_sfm.eval import batch

    objects.write(walks(plan) / "r1" / f"{NIGHT}_2200.mcap", b"no recording")
    (walk,) = find_walks(plan)[0]
    for hindered, lasting in ((True, False), (False, True)):
        result = {"ok": False, "error": "no", "hindered": hindered}
        monkeypatch.setattr(steps, "LogReader", _Whole)
        monkeypatch.setattr(batch, "run_one", lambda _, result=result: dict(result))
        assert map_walk(plan.root, walk, Config())["lasting"] is lasting


class _Whole:
    """A recording that is whole."""

    truncated = ""

    def __init__(self, _: Remote) -> None:
        pass

    def __enter__(self) -> _Whole:
        return self

    def __exit__(self, *_: object) -> None:
        pass


# -- the catalogue -----------------------------------------------------------------------------------------------


def test_rows_follow_the_head(plan: Plan, session: Path, others: list[Path]) -> None:
    for folder, night in ((session, "2026-11-24"), (others[0], NIGHT)):
        send_folder(folder, walks(plan) / "r1" / f"{night}_2200")
    carry_out(plan)
    query = "SELECT night, ok, version, why FROM walks ORDER BY night"
    assert rows(plan, query) == ["2026-11-24,True,1,", "2026-11-25,True,2,"]
    roll_back(plan.root / STORE / "map")
    assert rows(plan, query) == ["2026-11-24,True,1,", "2026-11-25,False,,its version was rolled back"]
    for table in ("versions", "sessions"):
        assert rows(plan, f"SELECT max(version), count(*) FROM {table}") == ["1,1"]
    send_folder(others[1], walks(plan) / "r1" / "2026-11-26_2200")
    carry_out(plan)
    assert rows(plan, "SELECT list(version ORDER BY version) FROM versions") == ['"[1, 3]"']
    assert rows(plan, query)[-1] == "2026-11-26,True,3,"


def test_a_session_has_one_row(plan: Plan, session: Path) -> None:
    for night in (NIGHT, "2026-11-26"):  # sent twice
        send_folder(session, walks(plan) / "r1" / f"{night}_2200")
    carry_out(plan)
    found = rows(plan, "SELECT walk, version, keyframes > 0, software IS NULL FROM sessions")
    assert found == [f"r1/{NIGHT}_2200,1,True,True"]  # the map does not say which program has made it
    assert rows(plan, "SELECT count(*), count(cost_s), min(cost_s) > 0 FROM versions") == ["1,1,True"]


def test_a_row_has_all_terms_the_health_and_the_cost(
    plan: Plan, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    objects.write(walks(plan) / "r1" / f"{NIGHT}_2200.mcap", b"a recording")
    mapped_as(monkeypatch, {"r1": session})
    made = steps._mapped  # pyright: ignore[reportPrivateUsage]

    def with_numbers(walk: Walk, config: Config, folder: Path) -> Result:
        return {**made(walk, config, folder), "stats": STATS, "terms": [0.01 * k for k in range(1, 9)]}

    monkeypatch.setattr(steps, "_mapped", with_numbers)
    carry_out(plan)
    terms = rows(plan, f"SELECT {', '.join(f'round({term}, 3)' for term in TERMS)} FROM walks")
    assert terms == ["0.573,1.146,1.719,2.292,2.865,6.0,4.011,4.584"]
    assert rows(plan, "SELECT lost_percent, software FROM walks") == [f"30.0,stereo-sfm {stereo_sfm.__version__}"]
    assert "tracking was lost" in rows(plan, "SELECT health FROM walks")[0]
    with opened(plan.root, [STORE]) as connection:
        lines, page = report(connection, tmp_path / "page", datetime.date(2026, 11, 26))
    unwell = next(line for line in lines if line.startswith(f"robot r1 of {STORE} is not well"))
    assert "30 % of the frames have no pose" in unwell and "Robots" in page.read_text()
    walk, update = rows(plan, "SELECT (SELECT sum(cost_s) FROM walks), (SELECT sum(cost_s) FROM versions)")[0].split(
        ","
    )
    assert float(walk) > float(update) > 0  # all steps of the walk


def test_rows_of_an_earlier_version_are_kept(plan: Plan, session: Path, others: list[Path]) -> None:
    marker = plan.root / STORE / "catalogue" / f"{NIGHT}.json"
    send_folder(session, walks(plan) / "r1" / f"{NIGHT}_2200")
    carry_out(plan)
    known = json.loads(objects.read(marker))
    del known["rows"][f"r1/{NIGHT}_2200"]["health"]
    objects.write(marker, json.dumps(known).encode())
    send_folder(others[0], walks(plan) / "r2" / f"{NIGHT}_2300")
    carry_out(plan)
    assert rows(plan, "SELECT robot, version FROM walks ORDER BY robot") == ["r1,1", "r2,2"]


STATS: dict[str, Any] = {
    "frames": 100, "tracked": 70, "unplaced": 0, "dropped": 0, "dropped_by_capture": 0, "left_out_of_log": 0,
    "log_ended": "", "lost_percent": 30.0, "max_lost_percent": 20.0, "pieces": 1, "loop_errors_at": [], "states": {},
    "lost_intervals": [{"reason": "dark", "begin_s": 0, "seconds": 1, "frames": 30}], "sensors": {}, "warnings": [],
    "inliers_median": 200.0, "row_errors": None, "start_check": None,
}  # fmt: skip


@pytest.mark.parametrize(("today", "old"), [("2026-11-29", [("lone", 9)]), ("2026-11-20", [("lone", 0)])])
def test_a_store_ages_by_the_day(today: str, old: list[tuple[str, int]], tmp_path: Path) -> None:
    """Also a lone one; and a walk without a date makes none young."""
    found = _stores({"lone": ["2026-11-20"]}, today, tmp_path)
    assert [(row[0], row[3]) for row in found] == old
    several = {"lone": ["2026-11-20", "undated"], "new": ["2026-11-20", "2026-11-28"], "odd": ["undated"]}
    ages = {row[0]: row[3] for row in _stores(several, "2026-11-29", tmp_path)}
    assert ages == {"lone": 9, "new": 1, "odd": None}


def _stores(nights: dict[str, list[str]], today: str, folder: Path) -> list[tuple[Any, ...]]:
    """The rows of stores, of a report."""
    duckdb = pytest.importorskip("duckdb")
    from stereo_sfm.fleet.catalogue import TABLES

    with duckdb.connect() as connection:
        for table, columns in TABLES.items():
            connection.execute(f"CREATE TABLE {table} ({', '.join(f'{n} {kind}' for n, kind in columns.items())})")
        for store, of_store in nights.items():
            for night in of_store:
                values = [store, night, "r1", f"r1/{night}"]
                connection.execute(
                    "INSERT INTO walks (store, night, robot, walk, ok) VALUES (?, ?, ?, ?, true)", values
                )
        lines, _ = report(connection, folder, datetime.date.fromisoformat(today))
        assert lines[0].startswith(f"{len(nights)} stores")
        from stereo_sfm.fleet.report import STORES

        return connection.execute(STORES).fetchall()


def test_a_catalogue_is_read_with_a_request_a_file(plan: Plan, session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    send_folder(session, walks(plan) / "r1" / f"{NIGHT}_2200")
    carry_out(plan)
    read = list[str]()
    whole = objects.read_tagged

    def counted(remote: Remote) -> tuple[bytes, str]:
        read.append(remote.name)
        return whole(remote)

    def never(remote: Remote) -> tuple[int, str]:
        raise AssertionError(remote)

    monkeypatch.setattr(objects, "read_tagged", counted)
    monkeypatch.setattr(objects, "size_and_tag", never)
    assert rows(plan, "SELECT count(*) FROM walks") == ["1"]
    tables = [f"{table}-{NIGHT}.parquet" for table in ("changes", "sessions", "versions", "walks")]
    assert sorted(read) == sorted(["head.json", *tables])
