"""One writer for a file, and an older file that stays until the new one is whole."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.cli import main
from stereo_sfm.commands.record import RecordOptions, write
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import open_regular, read_text
from stereo_sfm.log import topics
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.whole_file import WholeFile
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.recording.record import record
from stereo_sfm.types import StereoImage
from tests.log.recordings import fisheye_rig, stereo_images, write_recording

OTHER = """
import sys, time
from pathlib import Path
from stereo_sfm.log.whole_file import WholeFile
file = WholeFile(Path(sys.argv[1]), overwrite=sys.argv[2] == "yes")
print("mine", flush=True)
time.sleep(600)
"""


def _frames(path: Path) -> int:
    with LogReader(path) as reader:
        return len(reader.stamps(topics.LEFT_IMAGE))


def _source(count: int) -> MemorySource:
    return MemorySource(fisheye_rig(), stereo_images(count, np.random.default_rng(count)))


@pytest.mark.parametrize("overwrites", ["yes", "no"])
def test_a_second_writer_is_refused(overwrites: str, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    if overwrites == "yes":
        path.write_bytes(b"an older one")
    other = subprocess.Popen([sys.executable, "-c", OTHER, str(path), overwrites], stdout=-1, text=True)
    assert other.stdout is not None and other.stdout.readline() == "mine\n"
    before = path.read_bytes()
    with pytest.raises(StereoSfmError, match=r"another process is writing .*drive\.mcap: choose another name, or wait"):
        list(record(_source(2), path, overwrite=True))
    assert path.read_bytes() == before
    os.kill(other.pid, signal.SIGKILL)
    other.wait()
    list(record(_source(2), path, overwrite=True))  # a killed writer locks nothing
    assert _frames(path) == 2 and list(tmp_path.iterdir()) == [path]


def test_the_older_file_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    write_recording(path, _source(3))
    running = record(_source(5), path, overwrite=True)
    next(running)
    assert _frames(path) == 3
    running.close()
    assert _frames(path) == 1 and list(tmp_path.iterdir()) == [path]
    with pytest.raises(StereoSfmError, match="yielded no image"):
        list(record(MemorySource(fisheye_rig(), []), path, overwrite=True))
    assert _frames(path) == 1 and list(tmp_path.iterdir()) == [path]


def test_an_error_leaves_the_older_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "drive.mcap"
    write_recording(path, _source(5))

    class Broken(MemorySource):
        def __iter__(self) -> Iterator[StereoImage]:
            yield from itertools.islice(super().__iter__(), 2)
            raise StereoSfmError("the cable")

    with pytest.raises(StereoSfmError, match="the cable"):
        list(record(Broken(fisheye_rig(), stereo_images(4, np.random.default_rng(4))), path, overwrite=True))
    part = tmp_path / "drive.part.mcap"
    assert (_frames(path), _frames(part)) == (5, 2) and "what was written until the error is in" in caplog.text
    new = tmp_path / "new.mcap"
    with pytest.raises(StereoSfmError, match="the cable"):
        list(record(Broken(fisheye_rig(), stereo_images(4, np.random.default_rng(4))), new))
    assert _frames(new) == 2


@pytest.mark.parametrize("where", ["source", "terminal"])
def test_a_second_interrupt_leaves_the_older_file(where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "drive.mcap"
    write_recording(path, _source(5))

    class Interrupted(MemorySource):
        def __iter__(self) -> Iterator[StereoImage]:
            yield from itertools.islice(super().__iter__(), 2)
            raise KeyboardInterrupt

    class Bar:
        def step(self, text: str) -> None:
            if text.startswith("0.1"):
                raise KeyboardInterrupt

    monkeypatch.setattr("stereo_sfm.commands.record.progress", lambda *_: contextlib.nullcontext(Bar()))
    kind = Interrupted if where == "source" else MemorySource
    source = kind(fisheye_rig(), stereo_images(8, np.random.default_rng(4)))
    with pytest.raises(KeyboardInterrupt):
        write(source, path, RecordOptions(str(path), "png", overwrite=True, quiet=True), "record")
    assert _frames(path) == 5 and 0 < _frames(tmp_path / "drive.part.mcap") < 8


@pytest.mark.parametrize("there", [True, False])
def test_a_link_stays_and_the_file_that_it_names_is_replaced(there: bool, tmp_path: Path) -> None:
    large, path = tmp_path / "large disk" / "real.mcap", tmp_path / "drive.mcap"
    path.symlink_to(large)
    if there:
        write_recording(large, _source(3))
    running = record(_source(5), path, overwrite=True)
    next(running)
    if there:
        assert _frames(large) == 3
    list(running)
    assert path.is_symlink() and _frames(path) == _frames(large) == 5 and list(large.parent.iterdir()) == [large]
    path.unlink()
    path.symlink_to(path)
    with pytest.raises(StereoSfmError, match=r"cannot write .*drive\.mcap"):
        WholeFile(path, overwrite=True)


def test_a_full_disk_leaves_a_readable_file_and_the_older_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "drive.mcap"
    write_recording(path, _source(3))
    writer = LogWriter(path, overwrite=True)

    def full(fd: int, data: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("stereo_sfm.log.writer.os.write", full)
    part = tmp_path / "drive.part.mcap"
    with pytest.raises(StereoSfmError, match=r"drive.part.mcap is closed and readable .*drive.mcap is as it was"):
        writer.attach("a", "b")
    assert sorted(tmp_path.iterdir()) == [path, part] and (_frames(path), _frames(part)) == (3, 0)
    monkeypatch.undo()
    writer = LogWriter(path, overwrite=True)  # nobody holds them any more
    writer.discard()
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_is_for_those_that_the_umask_allows(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        WholeFile(tmp_path / "a", False).finish()
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


def test_pipes_devices_and_giants_are_refused_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe, link, large = tmp_path / "pipe.mcap", tmp_path / "zero.mcap", tmp_path / "large.toml"
    os.mkfifo(pipe)
    link.symlink_to("/dev/zero")
    with large.open("wb") as file:
        file.truncate(2 << 30)
    for path in (pipe, link, tmp_path):
        with pytest.raises(StereoSfmError, match="it is not a file"):
            open_regular(path)
        for command in (["recover", str(path), "-o", str(tmp_path / "out.mcap")], ["info", str(path)]):
            if path != tmp_path:
                assert main(command) == 2, command
    assert capsys.readouterr().err.count("it is not a file") >= 2
    with pytest.raises(StereoSfmError, match="2147 MB, more than 1074"):
        read_text(large)
    assert main(["run", "sim:loop", "-c", str(large)]) == 2
    assert "more than 1" in capsys.readouterr().err
