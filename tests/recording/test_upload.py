"""Recordings sent behind the recorder: each file once, and never deleted here before it is there."""

from __future__ import annotations

import errno
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log.whole_file import WholeFile
from stereo_sfm.recording import upload
from stereo_sfm.recording.quota import Disk, Quota, make_room
from stereo_sfm.recording.segments import RECORDING, SENT, Segment, new_recording, recordings, sent_whole
from stereo_sfm.recording.upload import Uploader
from stereo_sfm.service.config import RecordingConfig
from stereo_sfm.service.recorder import policy_of
from stereo_sfm.storage.objects import Unreachable
from stereo_sfm.storage.remote import Remote

TO = Remote("s3", "bucket", "robot")


class Bucket:
    """What arrives; `fails` so many next times."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.held: dict[str, bytes] = {}
        self.sent: list[str] = []
        self.fails = 0
        monkeypatch.setattr(upload, "send_file", self._file)
        monkeypatch.setattr(upload.objects, "write", self._write)

    def _file(self, path: Path, remote: Remote, *_: object) -> None:
        self._write(remote, path.read_bytes())

    def _write(self, remote: Remote, data: bytes) -> None:
        if self.fails:
            self.fails -= 1
            raise Unreachable(f"cannot write {remote}")
        self.held[str(remote)] = data
        self.sent.append(remote.name)


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Bucket:
    return Bucket(monkeypatch)


def recorded(root: Path, count: int = 3) -> list[Segment]:
    folder = new_recording(root, "sim:aisle", "full", datetime(2026, 11, 25, 22))
    out = [Segment.of(folder, k, 10 * k) for k in range(count)]
    for segment in out:
        segment.poses.write_bytes(b"p" * 10)
        segment.images.write_bytes(b"i" * 1000)
    return out


def test_each_file_is_sent_once_and_the_sums_last(tmp_path: Path, bucket: Bucket) -> None:
    segments = recorded(tmp_path)
    uploader = Uploader(tmp_path, TO, current=lambda: segments[-1])
    assert uploader.send_all() == 4 and not sent_whole(segments[0].folder)  # the last one is being written
    after = Uploader(tmp_path, TO)  # the service was started again
    assert after.send_all() == 2 and after.send_all() == 0
    assert sent_whole(segments[0].folder) and bucket.sent[-1] == SENT and RECORDING in bucket.sent
    assert len(bucket.sent) == len(set(bucket.sent))


def test_what_another_process_writes_waits(tmp_path: Path, bucket: Bucket) -> None:
    """`fleet upload` beside a running service; and a recorder that goes on while its last file is closed."""
    segments = recorded(tmp_path)
    segments[-1].images.unlink()
    writing = WholeFile(segments[-1].images, overwrite=False)
    assert Uploader(tmp_path, TO).send_all() == 4 and SENT not in bucket.sent
    writing.finish()
    assert Uploader(tmp_path, TO).send_all() == 2 and bucket.sent[-1] == SENT


def test_a_failure_goes_on_where_it_stopped(tmp_path: Path, bucket: Bucket) -> None:
    recorded(tmp_path)
    uploader = Uploader(tmp_path, TO)
    for _ in range(5):
        bucket.fails = 1
        with pytest.raises(StereoSfmError):
            uploader.send_all()
        uploader_files = len(bucket.sent)
        bucket.fails = 0
        uploader.send_all()
        assert len(bucket.sent) >= uploader_files
        recorded(tmp_path)
    uploader.send_all()
    names = list(bucket.held)
    assert len(names) == len(bucket.sent) == 6 * (6 + 2)


def test_the_quota_deletes_only_what_has_arrived(tmp_path: Path, bucket: Bucket) -> None:
    """A robot that was offline for three nights: its spool is full, and nothing of it is lost."""
    segments = [segment for _ in range(3) for segment in recorded(tmp_path)]
    quota = Quota(bytes=2000, sent_only=True)
    assert make_room(tmp_path, quota, None, lambda _: Disk(10**9, 10**9)) > 0
    assert all(segment.images.exists() for segment in segments)
    Uploader(tmp_path, TO).send_all()
    assert make_room(tmp_path, quota, None, lambda _: Disk(10**9, 10**9)) == 0
    assert sum(segment.images.exists() for segment in segments) == 1
    assert len(recordings(tmp_path)) == 1  # those without segments are gone
    assert sum(name.endswith(".images.mcap") for name in bucket.held) == 9


def test_a_recording_that_the_quota_has_emptied_still_gets_its_sums(tmp_path: Path, bucket: Bucket) -> None:
    segments = recorded(tmp_path, 2)
    uploader = Uploader(tmp_path, TO, current=lambda: Segment.of(segments[0].folder, 9, 90))
    uploader.send_all()
    for segment in segments:
        segment.delete()
    assert segments[0].folder.is_dir()
    Uploader(tmp_path, TO).send_all()
    assert not segments[0].folder.exists() and bucket.sent[-1] == SENT


def test_a_black_box_sends_marked_images_alone(tmp_path: Path, bucket: Bucket) -> None:
    segments = recorded(tmp_path)
    segments[1].mark("look")
    Uploader(tmp_path, TO, black_box=True).send_all()
    assert [name for name in bucket.sent if name.endswith(".images.mcap")] == [segments[1].images.name]


def test_a_black_box_keeps_what_is_marked_until_it_is_sent(tmp_path: Path, bucket: Bucket) -> None:
    """Images of unmarked segments make room; what is to be sent stays, also what the service marked itself."""
    config = RecordingConfig(folder=str(tmp_path), upload=str(TO), quota_gb=2000e-9, min_free_gb=0.0)
    quota = policy_of(config, "black_box").quota
    segments = recorded(tmp_path, 4)
    segments[0].mark("lost: tracking")
    segments[2].mark("lost: tracking")
    assert make_room(tmp_path, quota, None, lambda _: Disk(10**9, 10**9)) > 0
    assert [segment.images.exists() for segment in segments] == [True, False, True, False]
    assert all(segment.poses.exists() for segment in segments)
    Uploader(tmp_path, TO, black_box=True).send_all()
    assert make_room(tmp_path, quota, None, lambda _: Disk(10**9, 10**9)) == 0
    assert [segment.images.exists() for segment in segments] == [False, False, True, False]
    assert sum(name.endswith(".images.mcap") for name in bucket.held) == 2


def test_what_the_quota_deletes_meanwhile_stops_no_upload(
    tmp_path: Path, bucket: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    segments, send = recorded(tmp_path, 2), upload.send_file

    def sent(path: Path, remote: Remote, *more: Any) -> None:
        send(path, remote, *more)
        segments[0].images.unlink(missing_ok=True)

    monkeypatch.setattr(upload, "send_file", sent)
    assert Uploader(tmp_path, TO).send_all() == 3
    assert segments[1].images.name in bucket.sent and segments[0].images.name not in bucket.sent


def test_on_a_full_disk_what_is_sent_makes_room(
    tmp_path: Path, bucket: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its line in SHA256SUMS does not fit, or the beginning of it alone."""
    segments, opened = [segment for _ in range(2) for segment in recorded(tmp_path)], Path.open

    def full(path: Path, mode: str = "r", *args: Any, **options: Any) -> Any:
        if path.name == SENT and mode != "rb":
            with opened(path, mode, *args, **options) as stream:
                stream.write(b"0123" if "b" in mode else "0123")
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return opened(path, mode, *args, **options)

    current = segments[-1]
    monkeypatch.setattr(Path, "open", full)
    for sent in (10, 0):  # by another one, too: the settings were changed
        assert Uploader(tmp_path, TO, current=lambda: current).send_all() == sent
    assert len(bucket.sent) == len(bucket.held) == 10 + 2
    assert make_room(tmp_path, Quota(bytes=2100, sent_only=True), current, lambda _: Disk(10**9, 10**9)) == 0
    assert not segments[0].folder.exists() and current.images.exists()
    monkeypatch.setattr(Path, "open", opened)
    assert Uploader(tmp_path, TO).send_all() == 2 and len(bucket.sent) == len(bucket.held) == 2 * (6 + 2)
    lines = (current.folder / SENT).read_bytes()
    assert sent_whole(current.folder) and bucket.held[f"{TO}/{current.folder.name}/{SENT}"] + b"# complete\n" == lines
    assert len(lines.splitlines()) == 6 + 1 and b"0123" not in [line[:4] for line in lines.splitlines()]
