"""A bucket that is full: one line that says so, nothing is lost, and everything goes on once there is room."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.fleet.plan import find_walks, load_plan
from stereo_sfm.fleet.run import jobs_of
from stereo_sfm.fleet.versions import current
from stereo_sfm.jobs import Limits, Result, _within  # pyright: ignore[reportPrivateUsage]
from stereo_sfm.maps.saved_map import save_map
from stereo_sfm.recording.segments import SENT, Segment, new_recording
from stereo_sfm.recording.upload import Uploader
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import send_folder
from stereo_sfm.storage.remote import Remote
from tests.fleet.s3_server import FULL, Server
from tests.maps.maps import small_map

SAYS = "the storage is full: delete something, or raise its limit"


@pytest.fixture(autouse=True)
def impatient() -> Iterator[None]:
    """A 507 is tried again, as it may be of a moment."""
    with objects.patience(0.5):
        yield


@pytest.mark.parametrize("manner", FULL)
def test_every_server_s_answer_is_understood(place: str, s3: Server, manner: str, tmp_path: Path) -> None:
    large = tmp_path / "large"
    large.write_bytes(bytes(12 << 20))  # is sent in parts
    s3.faults(0.0, manner)
    for data in (b"1", large):
        with pytest.raises(StereoSfmError, match=SAYS):
            objects.write(Remote.of(place) / "x", data)
    with pytest.raises(StereoSfmError, match=SAYS):
        objects.exchange(Remote.of(place) / "x", b"1", None)
    assert not objects.exists(Remote.of(place) / "x")


def test_a_recording_waits_here(place: str, s3: Server, capsys: pytest.CaptureFixture[str]) -> None:
    target = f"{place}/walk.mcap"
    s3.faults(0.0, "ceph")
    assert main(["record", "sim:aisle?size=96x80&frames=3", "-o", target, "-q"]) == StereoSfmError.exit_code
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1 and SAYS in said and "it is kept: 'stereo-sfm fleet upload " in said
    s3.faults(0.0)
    assert main(said.split("'stereo-sfm ")[1].split("'")[0].split()) == 0
    assert main(["info", target]) == 0 and "3 at" in capsys.readouterr().out


def test_a_robot_s_recordings_wait_and_are_sent_later(place: str, s3: Server, tmp_path: Path) -> None:
    segment = Segment.of(new_recording(tmp_path, "sim:aisle", "full", datetime(2026, 11, 25, 22)), 0, 0)
    segment.poses.write_bytes(b"p" * 10)
    segment.images.write_bytes(b"i" * 1000)
    uploader = Uploader(tmp_path, Remote.of(place) / "r1")
    s3.faults(0.0, "ceph")
    with pytest.raises(StereoSfmError, match=SAYS):
        uploader.send_all()
    assert segment.images.exists() and not (segment.folder / SENT).exists()
    s3.faults(0.0)
    assert uploader.send_all() == 2
    assert objects.read(Remote.of(place) / "r1" / segment.folder.name / segment.images.name) == b"i" * 1000


def test_a_store_stays_as_it_was(place: str, s3: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By `map update`, and by a night of `fleet run`, which is made up for."""
    root = Remote.of(place)
    for k, noise in enumerate((0.2, 0.21, 0.22)):
        save_map(small_map(noise_px=noise)[1], tmp_path / f"map{k}")
    assert main(["map", "update", f"{place}/a/map", str(tmp_path / "map0")]) == 0
    for night in (1, 2):
        send_folder(tmp_path / f"map{night}", root / "a" / "walks" / "r1" / f"2026-11-2{night}_2200")
    plan = tmp_path / "plan.toml"
    plan.write_text(f'[fleet]\nroot = "{place}"\n')
    capsys.readouterr()
    s3.faults(0.0, "ceph")
    assert main(["map", "update", f"{place}/a/map", str(tmp_path / "map1")]) == StereoSfmError.exit_code
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1 and SAYS in said
    assert all(not result["ok"] and SAYS in result["error"] for result in _night(plan))
    assert current(root / "a" / "map").number == 1
    s3.faults(0.0)
    assert all(result["ok"] and not result.get("failed") for result in _night(plan))
    assert current(root / "a" / "map").number == 3 and len(current(root / "a" / "map").sessions) == 3


def _night(file: Path) -> list[Result]:
    """The jobs of `fleet run`, one after the other in this process."""
    plan, results = load_plan(file), dict[str, Result]()
    for job in jobs_of(plan, find_walks(plan)[0]):
        before = {name: results[name] for name in job.after}
        results[job.name] = _within(job.work, job.args, before, Limits())
    return list(results.values())
