"""A disk that is full, broken or without its folder for as long as it likes: nothing that was written is lost."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log import foxglove, repair, topics
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.recording import segment_recorder, segment_writers
from stereo_sfm.recording.quota import Disk, Quota
from stereo_sfm.recording.segment_recorder import SegmentRecorder
from stereo_sfm.recording.segments import RECORDING, about, describe, recordings, segments
from stereo_sfm.types import StereoImage
from tests.pipeline.test_pipeline import SlidingWall
from tests.recording.test_segments import frame, record, start, wait_for

WALL = next(iter(SlidingWall(1)))
MB = 1 << 20


class Refusing:
    """`os.write` that refuses while `number` is set, after a few bytes now and then."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.number, self.attempts, self._real = 0, 0, os.write
        monkeypatch.setattr("stereo_sfm.log.writer.os.write", self.write)
        monkeypatch.setattr(segment_writers, "AGAIN_S", 0.002)

    def write(self, fd: int, data: bytes) -> int:
        if not self.number:
            return self._real(fd, data)
        self.attempts += 1
        if self.attempts % 9 == 0:
            return self._real(fd, data[:3])
        raise OSError(self.number, os.strerror(self.number))

    def often(self) -> None:
        """Wait until it has refused more than sixty times more."""
        until = self.attempts + 70
        wait_for(lambda: self.attempts > until)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Refusing:
    return Refusing(monkeypatch)


def lean(count: int, first: int = 0) -> Generator[StereoImage]:
    return (replace(WALL, frame_id=k, stamp_ns=k * 50_000_000) for k in range(first, first + count))


def put(recorder: SegmentRecorder, count: int, first: int = 0) -> None:
    for image in lean(count, first):
        recorder.image(image)
        recorder.put(frame(image))


def of(folder: Path, topic: str = topics.FRAME) -> list[int]:
    """The sequence numbers of a topic in all files, in their order; each file opens."""
    found: list[int] = []
    for segment in segments(folder):
        with LogReader(segment.poses) as reader:
            found += [message.sequence for message in reader.messages([topic])]
    return found


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def opened(below: Path) -> list[str]:
    """Recorded files below a folder that this process has open, also deleted ones."""
    found: list[str] = []
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            found.append(os.readlink(descriptor))
        except OSError:
            continue
    return [name for name in found if name.startswith(f"{below}/") and ".mcap" in name]


def idle(recorder: SegmentRecorder) -> Callable[[], bool]:
    return lambda: all(w._queue.empty() for w in (recorder._poses, recorder._images))  # pyright: ignore[reportPrivateUsage]


@pytest.mark.parametrize("before", [0, 20])
def test_files_go_on_when_there_is_room_again(tmp_path: Path, disk: Refusing, before: int) -> None:
    """Also the first ones, and in a segment that begins meanwhile."""
    recorder, images = start(tmp_path), list(SlidingWall(110))
    record(recorder, images[:before])
    wait_for(idle(recorder))
    disk.number = errno.ENOSPC
    for image in images[before : before + 20]:
        recorder.image(image)
        recorder.put(frame(image))
    for image in images[before + 20 : 50]:
        recorder.put(frame(image))  # more images would not fit into their queue
    disk.often()
    assert recorder.state().full and "No space" in recorder.state().problem
    assert not (tmp_path / segment_recorder.RESERVE).exists()
    disk.number = 0
    wait_for(lambda: not recorder.state().problem)
    record(recorder, images[50:])
    recorder.close(20.0)
    parts = segments(recorder.folder)
    assert [part.name[:6] for part in parts] == ["00000_", "00001_", "00002_", "00003_"][: 4 if before else 3]
    assert len(names(recorder.folder)) == 2 * len(parts) + 1 and opened(tmp_path) == []
    assert of(recorder.folder) == of(recorder.folder, topics.MAP_POSE) == list(range(110))
    for part in parts:
        with LogReader(part.poses) as reader:
            assert reader.truncated == ""
    with open_source(recorder.folder) as source:
        assert [image.frame_id for image in source] == [*range(before + 20), *range(50, 110)]


def test_a_disk_at_its_brink_needs_no_more_names(tmp_path: Path, disk: Refusing) -> None:
    recorder = start(tmp_path, mode="lean", segment_s=1e9)
    for k in range(0, 1000, 10):
        disk.number = 0 if k % 20 else errno.EDQUOT
        put(recorder, 10, k)
        wait_for(idle(recorder)) if k % 20 else wait_for(lambda: recorder.state().full)
    disk.number = 0
    recorder.close(20.0)
    assert names(recorder.folder) == ["00000_000000.mcap", RECORDING] and of(recorder.folder) == list(range(1000))


def test_a_broken_disk_leaves_no_empty_file(tmp_path: Path, disk: Refusing) -> None:
    recorder = start(tmp_path, segment_s=1e9)
    put(recorder, 40)
    wait_for(idle(recorder))
    disk.number = errno.EIO
    put(recorder, 40, 40)
    disk.often()
    assert "Input/output" in recorder.state().problem and not recorder.state().full
    assert len(opened(tmp_path)) <= 3 and len(names(recorder.folder)) <= 5
    disk.number = 0
    wait_for(lambda: not recorder._poses.problem)  # pyright: ignore[reportPrivateUsage]
    put(recorder, 40, 80)
    recorder.close(20.0)
    files = [name for name in names(recorder.folder) if ".images" not in name]
    assert files == ["00000_000000.mcap", "00000_000000b.mcap", RECORDING]
    assert set(of(recorder.folder)) == set(range(120)) and opened(tmp_path) == []


def test_names_for_files_that_cannot_grow_do_not_run_out(tmp_path: Path, disk: Refusing) -> None:
    real = disk._real  # pyright: ignore[reportPrivateUsage]

    def small(fd: int, data: bytes) -> int:
        if os.fstat(fd).st_size > 20_000:
            raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
        return real(fd, data)

    recorder = start(tmp_path, mode="lean", segment_s=1e9)
    os.write = small  # the fixture puts it back
    put(recorder, 800)
    wait_for(idle(recorder))
    recorder.close(20.0)
    parts = segments(recorder.folder)
    assert len(parts) > 26 and {part.second for part in parts} == {0} and opened(tmp_path) == []
    letters = [part.name[12:] for part in parts]
    assert letters[:3] == ["", "b", "c"] and letters[24:27] == ["y", "z", "zb"]
    assert sorted(set(of(recorder.folder))) == list(range(800))


def test_a_file_that_is_deleted_gives_its_space_back(tmp_path: Path, disk: Refusing) -> None:
    """What waits for room must not hold the room that it waits for."""
    recorder = start(tmp_path, mode="lean", segment_s=1e9)
    put(recorder, 40)
    wait_for(idle(recorder))
    disk.number = errno.ENOSPC
    put(recorder, 40, 40)
    disk.often()
    (recorder.folder / "00000_000000.mcap").unlink()
    wait_for(lambda: not any(name.endswith(" (deleted)") for name in opened(tmp_path)))
    disk.number = 0
    put(recorder, 40, 80)
    recorder.close(20.0)
    assert of(recorder.folder)[-80:] == list(range(40, 120))


def test_the_end_while_the_disk_is_full_is_no_wait(tmp_path: Path, disk: Refusing) -> None:
    recorder = start(tmp_path, segment_s=1e9)
    put(recorder, 40)
    wait_for(idle(recorder))
    disk.number = errno.ENOSPC
    put(recorder, 400, 40)
    wait_for(lambda: recorder.state().full)
    segment_writers.AGAIN_S = 600.0  # the fixture puts it back
    recorder.close(20.0)
    threads = [w._thread for w in (recorder._poses, recorder._images)]  # pyright: ignore[reportPrivateUsage]
    assert not any(thread.is_alive() for thread in threads) and opened(tmp_path) == []
    found = of(recorder.folder)
    assert found == list(range(len(found))) and len(found) >= 32 and len(names(recorder.folder)) <= 3


@contextmanager
def small_disk(tmp_path: Path) -> Generator[Path]:
    place = tmp_path / "disk"
    place.mkdir()
    if (
        os.geteuid()
        or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "none", str(place)], check=False).returncode
    ):
        pytest.skip("cannot mount here")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=False)


def fill(path: Path) -> None:
    with path.open("ab", buffering=0) as file:
        for size in (1 << 16, 1 << 12, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                continue


@pytest.mark.parametrize("before", [0, 10, 35, 50, 200])
@pytest.mark.parametrize("to_the_end", [False, True])
def test_a_small_disk_that_somebody_fills(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: int, to_the_end: bool
) -> None:
    monkeypatch.setattr(segment_writers, "AGAIN_S", 0.01)
    with small_disk(tmp_path) as place:
        recorder = start(place / "r", Disk.of, mode="lean", segment_s=1e9, quota=Quota(1e9))
        put(recorder, before)
        wait_for(idle(recorder))
        (path,) = [*recorder.folder.glob("*.mcap")] or [recorder.folder / RECORDING]
        written = so_far(path)
        fill(place / "somebody")
        put(recorder, 300, before)
        wait_for(lambda: recorder.state().full)
        fill(place / "somebody")
        if not to_the_end:
            (place / "somebody").unlink()
            put(recorder, 40, before + 300)
        recorder.close(20.0)
        found = of(recorder.folder)
        assert opened(place) == [] and len(names(recorder.folder)) <= 2
        assert found == list(range(before + 340 if not to_the_end else len(found))) and len(found) >= len(written)


def so_far(path: Path) -> list[int]:
    if path.name == RECORDING:
        return []
    with LogReader(path) as reader:
        return [message.sequence for message in reader.messages([topics.FRAME])]


def written(path: Path, limit: int, again: Callable[[OSError], bool] | None) -> LogWriter:
    """A log that the system allows only some bytes."""
    writer = LogWriter(path, again=again)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        for k in range(10_000):
            writer.write(topics.LOG, foxglove.text(k, "INFO", f"{k * k}" * 40), k * 500_000_000, k)
    except StereoSfmError:
        return writer
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    raise AssertionError("it took everything")


def test_no_room_for_the_index_costs_no_message_of_a_segment(tmp_path: Path) -> None:
    writer = written(tmp_path / "a.mcap", 9_000, lambda _: False)
    with LogReader(tmp_path / "a.mcap") as reader:
        kept = [message.sequence for message in reader.messages()]
    with pytest.raises(StereoSfmError) as said:
        writer.write(topics.LOG, foxglove.text(0, "INFO", "x"), 0)
    assert (
        writer.refused
        and kept == list(range(len(kept)))
        and f"({len(kept)} messages" in str(said.value)
        and opened(tmp_path) == []
    )
    written(tmp_path / "b.mcap", 9_000, None)
    with LogReader(tmp_path / "b.mcap") as closed:
        assert closed.truncated == "" and 0 < len(list(closed.messages())) < len(kept)


def test_a_disk_that_refuses_even_the_index_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mcap"
    written(path, 9_000, lambda _: False)
    before = path.read_bytes()

    def refused(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(repair, "_write_all", refused)
    with pytest.raises(OSError, match="Input/output"):
        repair.finish_in_place(path)
    assert path.read_bytes() == before


def test_a_file_that_cannot_be_finished_is_closed(tmp_path: Path, disk: Refusing) -> None:
    writer = LogWriter(tmp_path / "a.mcap")
    (tmp_path / "a.mcap").unlink()
    disk.number = errno.ENOSPC
    with pytest.raises(StereoSfmError, match="recording stopped, No space left"):
        writer.attach("a", "b")
    with pytest.raises(StereoSfmError, match="has no message and is removed"):
        LogWriter(tmp_path / "b.mcap")
    assert opened(tmp_path) == [] and list(tmp_path.iterdir()) == []


def test_recording_json_is_whole_or_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segment_recorder, "EVERY_S", 0.02)
    recorder = start(tmp_path, mode="lean", segment_s=1e9)
    (recorder.folder / RECORDING).write_bytes(b"")  # as an older version left it
    wait_for(lambda: about(recorder.folder))
    with recorder._checking:  # pyright: ignore[reportPrivateUsage]
        pass  # the check that wrote it has ended

    def full(self: Path, text: str, **_: object) -> int:
        self.write_bytes(text.encode()[:10])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    put(recorder, 20)
    with monkeypatch.context() as broken:
        broken.setattr(Path, "write_text", full)
        with pytest.raises(OSError, match="No space"):
            describe(recorder.folder, *recorder._about)  # pyright: ignore[reportPrivateUsage]
        assert about(recorder.folder)["source"] == "wall" and not list(recorder.folder.glob("*.part"))
        wait_for(idle(recorder))
        recorder.folder.rename(tmp_path / "elsewhere")
        wait_for(recorder.folder.exists)
        before = recorder.segment
        put(recorder, 20, 20)
        assert recorder.segment == before and not about(recorder.folder)  # no new segment for every check
    wait_for(lambda: about(recorder.folder))
    put(recorder, 20, 40)
    recorder.close(20.0)
    assert recordings(tmp_path) == [recorder.folder] and of(recorder.folder)[-20:] == list(range(40, 60))
