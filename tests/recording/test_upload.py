"""Recordings sent behind the recorder: each file once, and never deleted here before it is there."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log.whole_file import WholeFile
from stereo_sfm.recording import upload
from stereo_sfm.recording.quota import Disk, Quota, make_room
from stereo_sfm.recording.segments import RECORDING, SENT, Segment, new_recording, recordings, sent_whole
from stereo_sfm.recording.upload import Uploader
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
