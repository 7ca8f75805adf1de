"""The steps of a night, one after the other and without Ray: whatever is repeated is done once."""

from __future__ import annotations

import dataclasses
import datetime
import io
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export import store_plan
from stereo_sfm.fleet.catalogue import ask, opened
from stereo_sfm.fleet.copies import fetch_version
from stereo_sfm.fleet.editing import checked_out
from stereo_sfm.fleet.plan import Plan, Walk, find_walks, load_plan, night_of
from stereo_sfm.fleet.run import forget_images, forget_versions
from stereo_sfm.fleet.steps import update_store
from stereo_sfm.fleet.versions import current, numbered, roll_back
from stereo_sfm.fleet.work_folder import work_folder
from stereo_sfm.maps import put_session as put_session_module
from stereo_sfm.maps.put_session import put_session
from stereo_sfm.maps.saved_map import load_map, save_map
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import send_folder
from stereo_sfm.storage.remote import Remote
from tests.fleet.nights import STORE, carry_out, walks
from tests.maps.maps import same, small_map


def test_a_night_is_done_once(plan: Plan, session: Path, tmp_path: Path) -> None:
    send_folder(session, walks(plan) / "r1" / "2026-11-25_2200")
    assert len(carry_out(plan, only=1)) == 1  # killed after the first step
    results = carry_out(plan)
    night = results[f"{STORE} 2026-11-25"]
    assert night["version"] == 1 and not night["failed"]
    assert all(result["resumed"] for result in carry_out(plan).values())
    assert current(plan.root / STORE / "map").number == 1
    fetch_version(plan.root / STORE / "map", current(plan.root / STORE / "map"), tmp_path / "robot")
    put_session(tmp_path / "by_hand", load_map(session), "r1", Config())
    a, b = load_map(tmp_path / "robot"), load_map(tmp_path / "by_hand")
    assert same(a.snapshot, b.snapshot) and (tmp_path / "robot" / "floor_plan.pgm").is_file()


def test_a_walk_that_is_sent_twice_counts_once(plan: Plan, session: Path) -> None:
    for name in ("2026-11-25_2200", "2026-11-25_2200_again"):
        send_folder(session, walks(plan) / "r1" / name)
    assert not carry_out(plan)[f"{STORE} 2026-11-25"]["failed"]
    send_folder(session, walks(plan) / "r1" / "2026-11-26_0100")
    assert not carry_out(plan)[f"{STORE} 2026-11-26"]["failed"]
    assert len(current(plan.root / STORE / "map").sessions) == 1
    with opened(plan.root, [STORE]) as connection:
        assert ask(connection, "SELECT count(*), count(DISTINCT session), max(version) FROM walks")[1] == "3,1,1"


def test_a_failed_walk_stops_nothing_and_a_truncated_one_is_taken_when_it_is_whole(plan: Plan, session: Path) -> None:
    send_folder(session, walks(plan) / "r1" / "2026-11-25_2200")
    objects.write(walks(plan) / "r2" / "2026-11-25_2200.mcap", b"no recording")
    cut = walks(plan) / "r3" / "2026-11-25_2200"
    save_map(small_map(seed=3)[1], session.parent / "third")
    send_folder(session.parent / "third", cut)
    whole = objects.read(cut / "points.npz")
    objects.write(cut / "points.npz", whole[:1000])
    night = carry_out(plan)[f"{STORE} 2026-11-25"]
    assert night["version"] == 1 and night["failed"].keys() == {
        "r2/2026-11-25_2200.mcap", "r3/2026-11-25_2200",
    }  # fmt: skip
    assert "is not what was sent" in night["failed"]["r3/2026-11-25_2200"]
    objects.write(cut / "points.npz", whole)
    results = carry_out(plan)
    again = next(result for name, result in results.items() if "r3" in name)
    assert again["ok"] and not again.get("resumed")


def test_what_has_not_arrived_as_a_whole_waits(plan: Plan, session: Path) -> None:
    objects.write(walks(plan) / "r1" / "00001_2026-11-25_220000" / "00000_000000.images.mcap", b"...")
    found, waiting = find_walks(plan)
    assert not found and [w.rpartition("/")[2] for w in waiting] == ["00001_2026-11-25_220000"]


def test_a_session_that_was_rolled_back_stays_out(plan: Plan, session: Path) -> None:
    place = plan.root / STORE / "map"
    send_folder(session, walks(plan) / "r1" / "2026-11-24_2200")
    carry_out(plan)
    from stereo_sfm.fleet.editing import checked_out

    with checked_out(place) as out:
        out.publish({"bad": "bad"}, ["bad"])
    assert roll_back(place).number == 1
    walk = Walk(STORE, "2026-11-25", "r1", "r1/bad", "nowhere", "x")
    result = {"ok": True, "id": "bad", "lasting": True}
    name = f"{STORE} 2026-11-25 r1/bad"
    night = update_store(plan.root, [walk], Config(), {name: result})
    assert "rolled back" in night["failed"]["r1/bad"] and current(place).sessions.keys().isdisjoint({"bad"})


def test_old_recordings_are_deleted_once_their_map_is_made(plan: Plan, session: Path) -> None:
    send_folder(session, walks(plan) / "r1" / "2026-11-25_2200")
    found, _ = find_walks(plan)
    today = datetime.date(2027, 1, 1)
    assert forget_images(plan, found, today) == 0  # nothing was made of it yet
    carry_out(plan)
    assert forget_images(plan, found, datetime.date(2026, 12, 1)) == 0
    assert forget_images(plan, found, today) > 0 and not find_walks(plan)[0]
    assert current(plan.root / STORE / "map").number == 1
    with opened(plan.root, [STORE]) as connection:
        assert ask(connection, "SELECT count(*) FROM walks")[1] == "1"


def test_old_recordings_without_a_date_or_an_end_are_deleted_too(plan: Plan, session: Path) -> None:
    send_folder(session, walks(plan) / "r1" / "evening")
    objects.write(walks(plan) / "r1" / "00001_2026-11-25_220000" / "00000_000000.images.mcap", b"...")
    carry_out(plan)
    found, waiting = find_walks(plan)
    assert forget_images(plan, found, datetime.date(2026, 11, 26), waiting) == 0
    later = datetime.date.today() + datetime.timedelta(400)
    assert forget_images(plan, found, later, waiting) > 3 and find_walks(plan) == ([], [])


def test_old_versions_go_as_the_plan_says(plan: Plan, session: Path, tmp_path: Path) -> None:
    place = plan.root / STORE / "map"
    send_folder(session, walks(plan) / "r1" / "2026-11-25_2200")
    carry_out(plan)
    with checked_out(place) as out:
        (out.folder / "note.txt").write_text("x" * 1000)
        out.publish({}, ["a note"])
    assert forget_versions(plan, [STORE, "other"]) == 0  # all are kept
    few = dataclasses.replace(plan, fleet=dataclasses.replace(plan.fleet, keep_versions=1))
    assert forget_versions(few, [STORE, "other"]) == 0  # nothing but the head's, which has all files of before
    with checked_out(place) as out:
        (out.folder / "note.txt").write_text("y" * 1000)
        out.publish({}, ["another"])
    assert forget_versions(few, [STORE, "other"]) > 10
    fetch_version(place, current(place), tmp_path / "robot")
    assert same(load_map(tmp_path / "robot").snapshot, load_map(session).snapshot)
    with pytest.raises(StereoSfmError, match="there is no"):
        fetch_version(place, numbered(place, 2), tmp_path / "other")


def test_what_a_killed_job_left_is_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    job = "from stereo_sfm.fleet.work_folder import work_folder\nwith work_folder() as f: print(f, flush=True); input()"
    jobs = [
        subprocess.Popen(
            [sys.executable, "-c", job], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            env={**os.environ, "TMPDIR": str(tmp_path)},
        )
        for _ in range(2)
    ]  # fmt: skip
    killed, alive = (Path(p.stdout.readline().decode().strip()) for p in jobs if p.stdout is not None)
    jobs[0].kill()
    jobs[0].wait()
    for folder in (killed, alive):
        (folder / "images.mcap").write_bytes(b"people")
        os.utime(folder, (0, 0))
    with work_folder() as mine:
        assert not killed.exists() and (alive / "images.mcap").is_file() and mine.is_dir()
    jobs[1].communicate(b"\n")
    assert not alive.exists() and not mine.exists()


def test_a_damaged_step_is_made_again(plan: Plan, session: Path) -> None:
    """Between the steps of a night, the session's map is damaged in the bucket."""
    send_folder(session, walks(plan) / "r1" / "2026-11-25_2200")
    (made,) = carry_out(plan, only=1).values()
    points = Remote.of(made["session"]) / "points.npz"
    whole = objects.read(points)
    objects.write(points, whole[:100])
    night = carry_out(plan)[f"{STORE} 2026-11-25"]
    assert "it is made again next time" in night["failed"]["r1/2026-11-25_2200"]
    night = carry_out(plan)[f"{STORE} 2026-11-25"]
    assert night["version"] == 1 and not night["failed"]


def test_an_error_of_ours_stops_no_night(plan: Plan, session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    send_folder(session, walks(plan) / "r1" / "2026-11-25_2200")
    save_map(small_map(seed=3)[1], session.parent / "another")
    send_folder(session.parent / "another", walks(plan) / "r2" / "2026-11-25_2200")
    put, failed = put_session_module.put_session, list[str]()

    def fails_once(folder: Path, saved: object, name: str, *rest: object, **more: object) -> object:
        if not failed:
            failed.append(name)
            raise LookupError("of ours")
        return put(folder, saved, name, *rest, **more)  # type: ignore[arg-type]

    def no_plan(_: Path) -> None:
        raise StereoSfmError("too few points")

    monkeypatch.setattr(put_session_module, "put_session", fails_once)
    monkeypatch.setattr(store_plan, "write_store_plan", no_plan)
    night = carry_out(plan)[f"{STORE} 2026-11-25"]
    assert night["version"] == 1 and night["failed"] == {failed[0]: "of ours"}
    assert "no floor plan: too few points" in current(plan.root / STORE / "map").changes
    night = carry_out(plan)[f"{STORE} 2026-11-25"]  # it is tried again, and is of another store
    assert "no loop joins them" in night["failed"][failed[0]]


@pytest.mark.parametrize(
    ("name", "night"), [("2026-13-45_x", "undated"), ("a_2026-13-45_2026-11-25", "2026-11-25"), ("x", "undated")]
)
def test_a_night_is_a_date(name: str, night: str) -> None:
    assert night_of(name) == night


def test_tables_of_other_versions_are_read(plan: Plan, session: Path) -> None:
    """An earlier one without a column, a later one with one more, in another order."""
    from pyarrow import BufferReader, parquet

    send_folder(session, walks(plan) / "r1" / "2026-11-25_2200")
    carry_out(plan)
    place = plan.root / STORE / "catalogue"
    table = parquet.read_table(BufferReader(objects.read(place / "walks-2026-11-25.parquet")))
    for night, other in (
        ("2026-11-24", table.drop_columns(["drift_percent"])),
        ("2026-11-26", table.select(table.column_names[::-1]).append_column("colour", [["red"]])),
    ):
        out = io.BytesIO()
        parquet.write_table(other, out)
        objects.write(place / f"walks-{night}.parquet", out.getvalue())
    with opened(plan.root, [STORE]) as connection:
        assert ask(connection, "SELECT count(*), count(DISTINCT robot), max(keyframes) > 0 FROM walks")[1] == "3,1,True"


def test_the_report_names_what_failed(
    plan: Plan, session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    send_folder(session, walks(plan) / "r1" / "2026-11-25_2200")
    objects.write(walks(plan) / "r2" / "2026-11-26_2200.mcap", b"no recording")
    carry_out(plan)
    assert main(["fleet", "report", str(tmp_path / "plan.toml"), "-o", str(tmp_path / "page")]) == 0
    printed = capsys.readouterr().out
    assert "1 stores, 2 nights, 2 walks, 1 of them in no map" in printed and "r2/2026-11-26_2200.mcap: " in printed
    page = (tmp_path / "page" / "fleet.html").read_text()
    assert "<svg" in page and "r2/2026-11-26_2200.mcap" in page
    assert "<td class=word>2026-11-26</td>" in page and "<th class=right>map MB</th>" in page
    assert (tmp_path / "page" / "stores.parquet").is_file()
    assert main(["fleet", "report", str(tmp_path / "plan.toml"), "--sql", "SELEC 1"]) == StereoSfmError.exit_code


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "names no place"),
        ('[fleet]\nroot = "s9://x"', "unknown scheme"),
        ('[fleet]\nrot = "s3://x"', "did you mean root"),
        ('[fleet]\nroot = "s3://x"\n[[walk]]\nstore = "a"', r"each \[\[walk\]\] has the texts"),
        (
            '[fleet]\nroot = "s3://x"\n[[walk]]\nstore = "a"\nnight = "x"\nrobot = "r"\nsource = "sim:loop"',
            "is a date such as 2026-11-25",
        ),
    ],
)
def test_a_wrong_plan_is_one_line(text: str, said: str, tmp_path: Path) -> None:
    pytest.importorskip("obstore")
    (tmp_path / "plan.toml").write_text(text)
    with pytest.raises(StereoSfmError, match=said):
        load_plan(tmp_path / "plan.toml")
