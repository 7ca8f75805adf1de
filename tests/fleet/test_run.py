"""`fleet run` as users call it: killed and started again, the result is the one of a run that nobody disturbed."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.fleet import run
from stereo_sfm.fleet.versions import current
from stereo_sfm.jobs import Job, Limits, Result, _within  # pyright: ignore[reportPrivateUsage]
from stereo_sfm.maps.saved_map import save_map
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import send_folder
from stereo_sfm.storage.remote import Remote
from tests.fleet.s3_server import Server
from tests.maps.maps import small_map

ROOT = Path(__file__).parents[2]


def in_turn(jobs: Sequence[Job], limits: Limits, address: str | None, extra: str) -> Iterator[tuple[Job, Result]]:
    """The jobs one after the other in this process."""
    results: dict[str, Result] = {}
    for job in jobs:
        before = {name: results[name] for name in job.after}
        results[job.name] = _within(job.work, job.args, before, limits)
        yield job, results[job.name]


def test_a_store_with_an_odd_name_fails_alone(
    place: str, s3: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run, "run_jobs", in_turn)
    save_map(small_map()[1], tmp_path / "map")
    root = Remote.of(place)
    send_folder(tmp_path / "map", root / "b" / "walks" / "r1" / "2026-11-25_2200")
    objects.write(root / "b" / "walks" / "r1" / "2026-11-25.bag", b"a bag")
    s3.request("PUT", f"/{root.bucket}/{root.key}/a/walks/r1//2026-11-25.mcap")
    plan = tmp_path / "plan.toml"
    plan.write_text(f'[fleet]\nroot = "{place}"\nkeep_images_days = 30\n[job]\nmemory_gb = 0.0\n')
    assert main(["fleet", "run", str(plan)]) == 3
    said = capsys.readouterr().err
    assert f"a: cannot list {place}/a/walks: the object '{root.key}/a/walks/r1//2026-11-25.mcap' has nothing" in said
    assert "b 2026-11-25: ok, version 1" in said and f"{place}/b/walks/r1/2026-11-25.bag" in said


def test_what_failed_is_named_and_what_is_done_is_not_repeated(
    place: str, s3: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command, its jobs one after the other in this process."""
    monkeypatch.setattr(run, "run_jobs", in_turn)
    save_map(small_map()[1], tmp_path / "map")
    send_folder(tmp_path / "map", Remote.of(place) / "a" / "walks" / "r1" / "2026-11-25_2200")
    objects.write(Remote.of(place) / "a" / "walks" / "r2" / "2026-11-25_2300.mcap", b"nothing")
    plan = tmp_path / "plan.toml"
    plan.write_text(f'[fleet]\nroot = "{place}"\n[job]\nmemory_gb = 0.0\n')
    assert main(["fleet", "run", str(plan)]) == 3
    printed = capsys.readouterr()
    assert "2 walks in 1 nights of 1 stores: 3 of 3 jobs done now, 2 failed" in printed.out
    assert "a 2026-11-25 r2/2026-11-25_2300.mcap: " in printed.err and "version 1" in printed.err
    assert main(["fleet", "run", str(plan)]) == 3
    assert "0 of 3 jobs done now, 2 failed" in capsys.readouterr().out
    assert main(["map", "versions", f"{place}/a/map"]) == 0
    assert "version 1: 1 sessions" in capsys.readouterr().out


@pytest.mark.slow
def test_a_killed_driver_goes_on(place: str, s3: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("ray")
    save_map(small_map()[1], tmp_path / "map")
    for store in ("a", "b"):
        send_folder(tmp_path / "map", Remote.of(place) / store / "walks" / "r1" / "2026-11-25_2200")
    plan = tmp_path / "plan.toml"
    plan.write_text(
        f'[fleet]\nroot = "{place}"\n[job]\nmemory_gb = 1.0\n'
        '[[walk]]\nstore = "a"\nnight = "2026-11-26"\nrobot = "r2"\n'
        'source = "sim:aisle?size=212x200&frames=12&rate=15"\n'
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    child = subprocess.Popen(
        [sys.executable, "-m", "stereo_sfm.cli", "fleet", "run", str(plan)], env=environment, stderr=subprocess.PIPE
    )
    assert child.stderr is not None
    child.stderr.readline()  # the first job has ended
    child.kill()
    child.wait()
    time.sleep(1.0)
    assert main(["fleet", "run", str(plan)]) in (0, 3)  # 3: the short walk may not be found in the other map
    first = capsys.readouterr()
    assert "2 walks" not in first.out and "3 walks in 3 nights of 2 stores" in first.out
    assert all(len(current(Remote.of(place) / store / "map").sessions) >= 1 for store in ("a", "b"))
    assert current(Remote.of(place) / "b" / "map").number == 1
    assert main(["fleet", "run", str(plan)]) in (0, 3)
    assert "0 of 6 jobs done now" in capsys.readouterr().out
