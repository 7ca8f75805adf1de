"""A recording in a bucket is the same source as here, and `info` reads a small part of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.cli import main
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.folder_lock import FolderLock
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.log.whole_file import WholeFile
from stereo_sfm.recording.describe import describe_file
from stereo_sfm.recording.record import record
from stereo_sfm.storage import objects
from stereo_sfm.storage.remote import Remote
from stereo_sfm.storage.spool import Spool
from stereo_sfm.types import StereoImage

FRAMES, WIDTH, HEIGHT = 2500, 96, 64


@pytest.fixture(scope="module")
def long_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """31 MB."""
    camera = Pinhole(WIDTH, HEIGHT, 60.0, 60.0, 47.5, 31.5)
    rig = Rig(camera, camera, se3.exp(np.array([0.1, 0, 0, 0, 0, 0])))
    rng = np.random.default_rng(1)
    images = [StereoImage(k, 0, *rng.integers(20, 200, (2, HEIGHT, WIDTH), np.uint8)) for k in range(20)]
    path = tmp_path_factory.mktemp("long") / "walk.mcap"
    for _ in record(MemorySource(rig, images, count=FRAMES), path, "raw"):
        pass
    return path


def test_info_reads_a_small_part(long_recording: Path, place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    remote = Remote.of(place) / "walk.mcap"
    objects.write(remote, long_recording)
    received: list[int] = []
    one, many = objects.read_range, objects.read_ranges

    def counted(remote: Remote, start: int, length: int) -> bytes:
        received.append(length)
        return one(remote, start, length)

    def counted_ranges(remote: Remote, wanted: list[tuple[int, int]]) -> list[bytes]:
        received.extend(length for _, length in wanted)
        return many(remote, wanted)

    monkeypatch.setattr(objects, "read_range", counted)
    monkeypatch.setattr(objects, "read_ranges", counted_ranges)
    found, here = describe_file(remote), describe_file(long_recording)
    assert found.bytes == here.bytes == long_recording.stat().st_size > 30e6
    assert found.images == here.images and found.messages == here.messages and found.problems == here.problems
    assert abs(found.seconds - here.seconds) < 1e-6 and found.calibration == here.calibration
    decoded = 150 * 2 * WIDTH * HEIGHT  # the most that the start check looks at
    assert sum(received) < decoded + 3e6, f"{sum(received)} bytes were read"


def test_images_are_the_same_bits(long_recording: Path, place: str) -> None:
    objects.write(Remote.of(place) / "walk.mcap", long_recording)
    with open_source(f"{place}/walk.mcap") as there, open_source(long_recording) as here:
        assert there.frame_count == here.frame_count == FRAMES
        for a, b, _ in zip(there, here, range(40), strict=False):
            assert a.stamp_ns == b.stamp_ns and a.right is not None and b.right is not None
            assert np.array_equal(a.left, b.left) and np.array_equal(a.right, b.right)


def test_a_recording_goes_to_a_bucket_and_stays_until_it_is_there(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from stereo_sfm.storage import spool

    target, source = f"{place}/walk.mcap", "sim:aisle?size=96x80&frames=3"
    send = spool.send_file

    def away(*_: object) -> None:
        raise objects.Unreachable("cannot write it")

    monkeypatch.setattr(spool, "send_file", away)
    assert main(["record", source, "-o", target, "-q"]) == 2
    said = capsys.readouterr().err
    assert "it is kept: 'stereo-sfm fleet upload " in said
    kept = Path(said.split("fleet upload ")[1].split()[0])
    recorded = kept.read_bytes()
    monkeypatch.setattr(spool, "send_file", send)
    assert main(["record", source, "-o", target, "-q"]) == 2  # the first one is not lost
    assert "was recorded for" in capsys.readouterr().err
    assert main(["fleet", "upload", str(kept), target]) == 0
    assert objects.read(Remote.of(target)) == recorded and not kept.exists()
    assert main(["record", source, "-o", target, "-q"]) == 2
    assert "exists: choose another name" in capsys.readouterr().err
    assert main(["record", source, "-o", target, "-q", "--overwrite"]) == 0
    assert main(["info", target]) == 0 and "3 at" in capsys.readouterr().out


def test_a_recording_on_its_way_is_not_replaced_or_sent_by_another_run(
    place: str, capsys: pytest.CaptureFixture[str]
) -> None:
    target, source = f"{place}/walk.mcap", "sim:aisle?size=96x80&frames=3"
    spool = Spool.of(Remote.of(target), overwrite=True)
    with open_source("sim:aisle?size=96x80&frames=8") as first:
        running = record(first, spool.file, overwrite=True)
        next(running)
        for command in (
            ["record", source, "-o", target, "-q", "--overwrite"],
            ["record", source, "-o", target, "-q"],
            ["fleet", "upload", str(spool.file), target],
        ):
            assert main(command) == 2
            said = capsys.readouterr().err
            assert "another run is writing" in said and "wait until it is sent" in said and "not sent" not in said
        for _ in running:
            pass
    assert main(["record", source, "-o", target, "-q", "--overwrite"]) == 2  # it is whole, and being sent
    spool.send()
    assert main(["info", target]) == 0 and "8 at" in capsys.readouterr().out and not spool.file.exists()
    del spool
    assert main(["record", source, "-o", target, "-q", "--overwrite"]) == 0
    assert main(["info", target]) == 0 and "3 at" in capsys.readouterr().out


def test_an_unsent_recording_stays_until_its_replacement_is_whole(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    target = Remote.of(f"{place}/walk.mcap")
    kept = Spool.of(target, overwrite=False).file
    kept.write_bytes(b"not sent yet")
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(b"\x89MCAP0\r\n" + bytes(64))
    assert main(["record", str(damaged), "-o", str(target), "-q", "--overwrite"]) == 2
    assert kept.read_bytes() == b"not sent yet"
    monkeypatch.setattr("stereo_sfm.storage.spool.send_file", lambda *_: _unreachable())
    assert main(["record", "sim:aisle?size=96x80&frames=3", "-o", str(target), "-q", "--overwrite"]) == 2
    images = describe_file(kept).images
    assert "it is kept" in capsys.readouterr().err and images is not None and images.count == 3


def test_an_unsent_recording_is_in_no_cache(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that an earlier version left in the cache is taken over, unless a program of that version writes it."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    target, source = f"{place}/walk.mcap", "sim:aisle?size=96x80&frames=3"
    spool = Spool.of(Remote.of(target), overwrite=False)
    kept = spool.file
    assert tmp_path / "state" in kept.parents
    del spool
    left = tmp_path / "cache" / "spool" / kept.parent.name / kept.name
    left.parent.mkdir(parents=True)
    left.write_bytes(b"not sent yet")
    with FolderLock(left.parent, "wait"):
        assert main(["record", source, "-o", target, "-q", "--overwrite"]) == 2
        assert "another run is writing" in capsys.readouterr().err and left.exists()
    assert main(["record", source, "-o", target, "-q"]) == 2
    assert f"{kept} was recorded for" in capsys.readouterr().err and not left.exists()
    assert main(["fleet", "upload", str(kept), target]) == 0
    assert objects.read(Remote.of(target)) == b"not sent yet"


def _unreachable() -> None:
    raise objects.Unreachable("cannot write it")


def test_what_is_being_written_is_not_uploaded(place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "run" / "log.mcap"
    writing = WholeFile(file, overwrite=False)
    for path in (file, file.parent):
        assert main(["fleet", "upload", str(path), f"{place}/run"]) == 2
        assert "log.mcap is being written" in capsys.readouterr().err
    writing.finish()
    with pytest.raises(StereoSfmError):
        objects.read(Remote.of(f"{place}/run/log.mcap"))
    assert main(["fleet", "upload", str(file.parent), f"{place}/run"]) == 0
