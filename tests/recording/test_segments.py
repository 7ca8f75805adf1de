"""Recording all day: segments, the quota, black box, marks, and disks that are full or slow."""

from __future__ import annotations

import errno
import os
import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.config import Config
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log import topics
from stereo_sfm.log.reader import LogReader, Record
from stereo_sfm.recording import segment_recorder as module
from stereo_sfm.recording import segment_writers
from stereo_sfm.recording.quota import Disk, Quota, forget_images, make_room, used_bytes
from stereo_sfm.recording.segment_recorder import Policy, SegmentRecorder
from stereo_sfm.recording.segments import RECORDING, Segment, about, delete_recording, listed, recordings, segments
from stereo_sfm.types import Frame, ImuSamples, Observations, StereoImage, TrackState
from tests.pipeline.test_pipeline import SlidingWall

GB = 1e9
ROOMY = Disk(int(100 * GB), int(90 * GB))
PERIOD_NS = 33_333_333


def policy(root: Path, **changes: object) -> Policy:
    default = Policy(root, "full", "png", 0.99, 1e9, Quota(10 * GB), 10.0, 1.0, 1.0)
    return replace(default, **changes)  # pyright: ignore[reportArgumentType]


def frame(image: StereoImage) -> Frame:
    pose, none = np.eye(4), Observations.empty()
    return Frame(image.frame_id, image.stamp_ns, pose, np.eye(6), TrackState.OK, "", none, -1, pose)


def wait_for(what: Callable[[], object]) -> None:
    end = time.monotonic() + 20.0
    while not what():
        assert time.monotonic() < end
        time.sleep(0.01)


def record(to: SegmentRecorder, images: list[StereoImage]) -> None:
    for image in images:
        to.image(image)
        to.put(frame(image))
        while to._images._queue.qsize() > 8:  # pyright: ignore[reportPrivateUsage]
            time.sleep(0.005)


def start(root: Path, disk: Callable[[Path], Disk] = lambda _: ROOMY, **changes: object) -> SegmentRecorder:
    return SegmentRecorder(policy(root, **changes), SlidingWall(1).rig, Config(), "wall", disk=disk)


def fake(root: Path, seconds: list[int], size: int = 1000) -> list[Segment]:
    """A recording of empty segments."""
    folder = module.new_recording(root, "fake", "full", datetime(2026, 1, 2))
    made = [Segment.of(folder, k, second) for k, second in enumerate(seconds)]
    for segment in made:
        segment.images.write_bytes(bytes(size))
        segment.poses.write_bytes(bytes(size // 10))
    return made


def test_segments_open_alone_and_replay_as_one(tmp_path: Path) -> None:
    images = list(SlidingWall(100))
    recorder = start(tmp_path)
    record(recorder, images)
    recorder.close(20.0)
    (folder,) = recordings(tmp_path)
    parts = segments(folder)
    assert [part.name for part in parts] == ["00000_000000", "00001_000001", "00002_000002", "00003_000003"]
    with open_source(folder) as whole:
        again = list(whole)
        assert whole.frame_count == 100 and whole.rig.baseline == SlidingWall(1).rig.baseline
        listed_stamps = whole.stamps()
        assert listed_stamps is not None and len(listed_stamps.stamp_ns) == 100
    for a, b in zip(images, again, strict=True):
        assert (a.frame_id, a.stamp_ns) == (b.frame_id, b.stamp_ns)
        np.testing.assert_array_equal(a.left, b.left)
        assert a.right is not None and b.right is not None
        np.testing.assert_array_equal(a.right, b.right)
    with open_source(parts[2].images) as alone:
        assert [image.frame_id for image in alone] == list(range(60, 90))
    with LogReader(parts[2].poses) as reader:
        assert reader.truncated == "" and reader.metadata("totals")["frames"] == "30"
        assert len(list(reader.messages([topics.THUMBNAIL]))) == 1
    assert listed(folder)["segments"] == 4
    assert images[-1].stamp_ns - images[0].stamp_ns > 3e9
    assert listed(folder)["seconds"] == round((images[-1].stamp_ns - images[0].stamp_ns) / 1e9)
    delete_recording(tmp_path, folder.name)
    assert recordings(tmp_path) == []
    with pytest.raises(StereoSfmError, match="no recording"):
        delete_recording(tmp_path, "../..")


def test_the_length_of_a_short_and_of_an_unfinished_recording(tmp_path: Path) -> None:
    recorder = start(tmp_path, segment_s=60.0)
    (folder,) = recordings(tmp_path)
    os.utime(folder / RECORDING, (1e9, 1e9))  # the first image may come late
    assert recorder.state().seconds == 0
    record(recorder, list(SlidingWall(61)))
    assert recorder.state().seconds == 2
    recorder.close(20.0)
    (part,) = segments(folder)
    assert part.second == 0 and listed(folder)["seconds"] == 2  # by its poses
    whole = part.poses.read_bytes()
    part.poses.write_bytes(whole[: len(whole) // 2])  # as while it is written: by the clock of the disk
    began_s = (folder / RECORDING).stat().st_mtime
    assert time.time() - began_s < 60
    os.utime(part.poses, (began_s + 7, began_s + 7))
    assert listed(folder)["seconds"] == 7


def test_a_segment_ends_at_its_size(tmp_path: Path) -> None:
    recorder = start(tmp_path, segment_s=1e9, segment_bytes=2e6, image_format="raw")
    record(recorder, list(SlidingWall(90)))
    recorder.close(20.0)
    sizes = [segment.images.stat().st_size for segment in segments(recorder.folder)]
    assert len(sizes) >= 3 and max(sizes) < 8e6  # a chunk and what waits beyond the limit


def test_images_that_wait_for_a_full_segment_do_not_end_the_next_one(tmp_path: Path) -> None:
    recorder = start(tmp_path, segment_s=1e9, segment_bytes=2e6, image_format="raw")
    writer = recorder._images  # pyright: ignore[reportPrivateUsage]
    write, waits = writer._write, threading.Event()  # pyright: ignore[reportPrivateUsage]
    writer._write = lambda item: (waits.wait(), write(item))[1]  # pyright: ignore
    images = list(SlidingWall(30))
    for image in images[:8]:
        recorder.image(image)
    writer.bytes_written = 3_000_000  # as if they were written: the next image begins a segment
    recorder.image(images[8])
    waits.set()
    wait_for(lambda: not writer._queue.qsize())  # pyright: ignore[reportPrivateUsage]
    for image in images[9:12]:
        recorder.image(image)
        wait_for(lambda: not writer._queue.qsize())  # pyright: ignore[reportPrivateUsage]
    recorder.close(20.0)
    counts = []
    for segment in segments(recorder.folder):
        with open_source(segment.images) as alone:
            counts.append(sum(1 for _ in alone))
    assert counts[:2] == [8, 4], counts


def test_a_folder_that_is_deleted_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "EVERY_S", 0.02)
    images, recorder = list(SlidingWall(90)), start(tmp_path, segment_s=60.0)
    record(recorder, images[:20])
    wait_for(lambda: segments(recorder.folder))
    shutil.rmtree(recorder.folder)
    wait_for(lambda: recorder._folder_gone)  # pyright: ignore[reportPrivateUsage]
    record(recorder, images[20:])
    recorder.close(20.0)
    assert about(recorder.folder)["source"] == "wall" and recorder.state().problem == ""
    with open_source(recorder.folder) as source:
        assert [image.frame_id for image in source] == list(range(20, 90))


def test_the_reason_of_a_disk_that_refuses_is_a_sentence() -> None:
    said = segment_writers._said(FileNotFoundError(2, "No such file or directory", "/r/a.mcap"))  # pyright: ignore
    assert said == "/r/a.mcap: No such file or directory"
    assert "Errno" not in segment_writers._said(OSError(28, "No space left on device"))  # pyright: ignore


def test_a_folder_that_cannot_be_described_is_not_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    for _ in range(3):
        with pytest.raises(OSError, match="No space"):
            module.new_recording(tmp_path, "fake", "full", datetime(2026, 1, 2))
    assert not list(tmp_path.iterdir())


def test_the_oldest_unmarked_goes_first(tmp_path: Path) -> None:
    old, new = fake(tmp_path, [0, 60, 120]), fake(tmp_path, [0, 60])
    old[1].mark("bump")
    quota = Quota(bytes=3 * 1100)
    assert make_room(tmp_path, quota, new[-1], lambda _: ROOMY) == 0
    assert [s.name for s in segments(old[0].folder)] == [old[1].name] and len(segments(new[0].folder)) == 2
    assert make_room(tmp_path, Quota(bytes=10), new[-1], lambda _: ROOMY) == 2 * 1100 - 10  # marked and current stay
    assert used_bytes(tmp_path) == 2200
    old[1].mark_file.unlink()
    make_room(tmp_path, Quota(bytes=1100), new[-1], lambda _: ROOMY)
    assert recordings(tmp_path) == [new[0].folder]


def test_marks_of_the_service_age_and_leave_room(tmp_path: Path) -> None:
    """Many losses: the newest stay as long as they fit into half of the quota, and what comes is recorded."""
    old, new = fake(tmp_path, list(range(0, 600, 60))), fake(tmp_path, [0, 60, 120])
    for segment in (*old, new[0]):
        for _ in range(5):
            segment.mark("lost: dark")
    assert old[0].mark_file.read_text() == "lost: dark\n" and not old[0].marked_by_hand
    old[2].mark("2026-01-02T10:00:00 a bump")
    assert old[2].marked_by_hand and old[2].marked
    assert make_room(tmp_path, Quota(bytes=6 * 1100), new[-1], lambda _: ROOMY) == 0
    left = [s for folder in recordings(tmp_path) for s in segments(folder)]
    assert left == [old[2], old[8], old[9], *new]  # those of the person, the newest losses, the unmarked newest
    make_room(tmp_path, Quota(bytes=3 * 1100), new[-1], lambda _: ROOMY)
    assert [s for folder in recordings(tmp_path) for s in segments(folder)] == [old[2], new[0], new[2]]
    assert make_room(tmp_path, Quota(bytes=1100), new[-1], lambda _: ROOMY) == 1100  # only the person's is too many
    make_room(tmp_path, Quota(1e9, min_free=50), None, lambda _: Disk(10**9, 0))
    assert old[2].images.exists() and not new[2].images.exists()


def test_percent_and_free_space_count_as_well() -> None:
    disk = Disk(1000, 100)
    assert Quota(bytes=1e9, percent=50).excess(600, disk) == 100
    assert Quota(bytes=1e9, min_free=300).lacking(disk) == 200
    assert Quota(bytes=1e9).excess(600, disk) == 0


def test_a_disk_that_others_filled_costs_images_only(tmp_path: Path) -> None:
    parts = fake(tmp_path, [0, 60, 120])
    parts[0].mark("bump")
    assert make_room(tmp_path, Quota(1e9, min_free=50), parts[-1], lambda _: Disk(10**9, 0)) == 0
    assert [s.images.exists() for s in parts] == [True, False, True] and all(s.poses.exists() for s in parts)


def test_a_black_box_counts_recorded_time(tmp_path: Path) -> None:
    old, new = fake(tmp_path, [0, 60, 120, 180]), fake(tmp_path, [0, 60, 120])
    old[1].mark("loss")
    assert forget_images(tmp_path, keep_s=180.0, segment_s=60.0, current=new[-1]) == 2
    assert [s.images.exists() for s in (*old, *new)] == [False, True, False, True, True, True, True]
    assert all(s.poses.exists() for s in (*old, *new))


def test_marks_keep_what_lies_around(tmp_path: Path) -> None:
    recorder = start(tmp_path, segment_s=0.49, mark_before_s=0.6, mark_after_s=0.6)
    images = list(SlidingWall(150))
    record(recorder, images[:75])  # 2.5 s
    recorder.mark("bump")
    record(recorder, images[75:])
    recorder.close(20.0)
    marked = [number for number, segment in enumerate(segments(recorder.folder)) if segment.marked]
    assert marked == [3, 4, 5, 6]


def test_a_loss_does_not_take_over_a_mark_by_hand(tmp_path: Path) -> None:
    """Else what a person wanted to keep ages."""
    recorder = start(tmp_path, segment_s=0.49, mark_before_s=0.1, mark_after_s=1.2)
    images = list(SlidingWall(150))
    record(recorder, images[:60])
    recorder.mark("bump")
    record(recorder, images[60:66])
    recorder.mark("lost: dark")
    record(recorder, images[66:])
    recorder.close(20.0)
    found = segments(recorder.folder)
    by_hand = [number for number, segment in enumerate(found) if segment.marked_by_hand]
    alone = [number for number, segment in enumerate(found) if segment.marked and not segment.marked_by_hand]
    assert len(by_hand) >= 3 and by_hand == list(range(by_hand[0], by_hand[-1] + 1))
    assert all(number > by_hand[-1] for number in alone)


def test_the_quota_is_kept_to_a_segment_however_fast_they_follow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "EVERY_S", 3600.0)
    images = list(SlidingWall(120))
    size = images[0].left.nbytes + images[0].right.nbytes  # type: ignore[union-attr]
    fake(tmp_path, [0, 1, 2, 3], 10 * size)  # of a recorder that was killed
    recorder = start(tmp_path, image_format="raw", segment_s=0.33, quota=Quota(25 * size))
    assert used_bytes(tmp_path) <= 25 * size
    for begin in range(0, 120, 10):
        record(recorder, images[begin : begin + 10])
        wait_for(lambda: used_bytes(tmp_path) <= 25 * size + 11 * size)
    recorder.close(20.0)
    assert used_bytes(tmp_path) > 10 * size and len(segments(recorder.folder)) < 6


def test_a_full_disk_costs_images_and_no_pose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "EVERY_S", 0.02)
    free = [int(90 * GB)]
    full = {"quota": Quota(10 * GB, min_free=GB), "segment_s": 60.0}  # ended segments' images go to make room
    recorder = start(tmp_path, lambda _: Disk(int(100 * GB), free[0]), **full)
    images = list(SlidingWall(90))
    images = [replace(i, imu=ImuSamples(np.array([i.stamp_ns]), np.zeros((1, 3)), np.ones((1, 3)))) for i in images]
    record(recorder, images[:30])
    free[0] = int(0.5 * GB)
    wait_for(lambda: recorder.state().problem)
    assert recorder.state().full and "disk full" in recorder.state().problem
    record(recorder, images[30:60])
    free[0] = int(90 * GB)
    wait_for(lambda: not recorder.state().full)
    record(recorder, images[60:])
    recorder.close(20.0)
    poses = [r.sequence for s in segments(recorder.folder) for r in messages(s.poses, topics.FRAME)]
    drops = [r.sequence for s in segments(recorder.folder) for r in messages(s.poses, topics.DROPPED)]
    assert sorted(poses) == list(range(90)) and drops == list(range(30, 60)) and recorder.images_dropped == 30
    with open_source(recorder.folder) as source:
        kept = list(source)
    assert [i.frame_id for i in kept] == [*range(30), *range(60, 90)] and kept[30].dropped_before == 30
    assert kept[30].imu is not None and len(kept[30].imu) == 31  # those of the dropped images, too


def test_an_image_that_is_omitted_is_said_to_be_missing_and_its_samples_come_with_the_next(tmp_path: Path) -> None:
    recorder = start(tmp_path, quota=Quota(10 * GB), segment_s=60.0)
    images = list(SlidingWall(10))
    images = [replace(i, imu=ImuSamples(np.array([i.stamp_ns]), np.zeros((1, 3)), np.ones((1, 3)))) for i in images]
    record(recorder, images[:5])
    recorder.omit(images[5], "the recorder is slow")
    record(recorder, images[6:])
    recorder.close(20.0)
    drops = [r.sequence for s in segments(recorder.folder) for r in messages(s.poses, topics.DROPPED)]
    with open_source(recorder.folder) as source:
        kept = list(source)
    assert [i.frame_id for i in kept] == [0, 1, 2, 3, 4, 6, 7, 8, 9] and drops == [5] and kept[5].dropped_before == 1
    assert kept[5].imu is not None and list(kept[5].imu.stamp_ns) == [images[5].stamp_ns, images[6].stamp_ns]


def messages(path: Path, topic: str) -> list[Record]:
    with LogReader(path) as reader:
        return list(reader.messages([topic]))


def test_a_disk_that_refuses_everything_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segment_writers, "AGAIN_S", 0.05)
    refuse = [False]
    real = segment_writers.LogWriter.write

    def write(self: segment_writers.LogWriter, *args: object) -> None:
        if refuse[0]:
            self.close()
            raise StereoSfmError("recording stopped, No space left on device")
        real(self, *args)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(segment_writers.LogWriter, "write", write)
    recorder = start(tmp_path)
    images = list(SlidingWall(60))
    record(recorder, images[:10])
    wait_for(lambda: recorder._poses._queue.empty())  # pyright: ignore[reportPrivateUsage]
    refuse[0] = True
    record(recorder, images[10:20])
    wait_for(lambda: "No space" in recorder.state().problem)
    assert not (tmp_path / module.RESERVE).exists()  # given up for poses
    refuse[0] = False
    wait_for(lambda: not recorder._poses.problem)  # pyright: ignore[reportPrivateUsage]
    record(recorder, images[20:])
    recorder.close(20.0)
    poses = {r.sequence for s in segments(recorder.folder) for r in messages(s.poses, topics.FRAME)}
    assert poses == set(range(60))


@pytest.mark.parametrize(("number", "full"), [(errno.ENOSPC, True), (errno.EDQUOT, True), (errno.EIO, False)])
def test_only_a_full_disk_is_called_full(
    number: int, full: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = start(tmp_path)
    images = list(SlidingWall(60))
    record(recorder, images[:10])
    wait_for(lambda: recorder._poses._queue.empty())  # pyright: ignore[reportPrivateUsage]

    def refused(fd: int, data: object) -> int:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as broken:
        broken.setattr("stereo_sfm.log.writer.os.write", refused)
        record(recorder, images[10:20])
        wait_for(lambda: os.strerror(number) in recorder.state().problem)
        assert recorder.state().full == full
        recorder.close(1.0)


def test_a_slow_disk_drops_images_and_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = segment_writers.ImageLog.image

    def slow(self: segment_writers.ImageLog, image: object) -> None:
        time.sleep(0.3)
        real(self, image)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(segment_writers.ImageLog, "image", slow)
    recorder = start(tmp_path)
    began = time.monotonic()
    for image in SlidingWall(60):
        recorder.image(image)
        recorder.put(frame(image))
    assert time.monotonic() - began < 10.0 and recorder.images_dropped > 20  # all would take 18
    assert recorder.state().problem == "the disk is slow: images are dropped"
    recorder.close(20.0)
    poses = [r.sequence for s in segments(recorder.folder) for r in messages(s.poses, topics.FRAME)]
    assert poses == list(range(60))


def test_a_folder_without_images_is_reported(tmp_path: Path) -> None:
    recorder = start(tmp_path, mode="lean")
    record(recorder, list(SlidingWall(30)))
    recorder.close(20.0)
    with pytest.raises(StereoSfmError, match="no segment with images"):
        open_source(recorder.folder)
