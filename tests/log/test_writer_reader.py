"""Writing and reading a recording: every bit, chunk sizes, metadata, time ranges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers import open_source
from stereo_sfm.drivers.mcap.source import McapSource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log import foxglove, topics
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.writer import CHUNK_BYTES, CHUNK_NS, LogWriter
from tests.log.recordings import (
    PERIOD_NS,
    START_NS,
    MemorySource,
    assert_same_image,
    depth_images,
    fisheye_rig,
    sequence_truth,
    stereo_images,
    write_recording,
)


def _assert_same_rig(a: Rig, b: Rig) -> None:
    for name in ("left", "right"):
        x, y = getattr(a, name), getattr(b, name)
        assert type(x) is type(y) and x.size == y.size and x.params.tobytes() == y.params.tobytes()
    assert a.left_T_right.tobytes() == b.left_T_right.tobytes()
    assert a.body_T_left.tobytes() == b.body_T_left.tobytes()
    assert (a.depth, a.name, a.serial) == (b.depth, b.name, b.serial)


@pytest.mark.parametrize("image_format", ["raw", "png"])
def test_a_lossless_recording_gives_back_every_bit(tmp_path: Path, image_format: str) -> None:
    rng = np.random.default_rng(1)
    images, truth = stereo_images(12, rng), sequence_truth(60, rng)
    path = tmp_path / "a.mcap"
    write_recording(path, MemorySource(fisheye_rig(), images, truth), image_format)
    with open_source(path) as source:
        back = list(source)
        again = list(source)
        _assert_same_rig(fisheye_rig(), source.rig)
        assert source.frame_count == len(images) == len(back) == len(again)
        assert source.ground_truth is not None
        assert source.ground_truth.stamp_ns.tobytes() == truth.stamp_ns.tobytes()
        assert source.ground_truth.poses.tobytes() == truth.poses.tobytes()
    for one, other, third in zip(images, back, again, strict=True):
        assert_same_image(one, other)
        assert_same_image(one, third)


def test_depth_images_give_back_every_bit(tmp_path: Path) -> None:
    rig, images = depth_images(4, np.random.default_rng(2))
    write_recording(tmp_path / "d.mcap", MemorySource(rig, images))
    with open_source(tmp_path / "d.mcap") as source:
        _assert_same_rig(rig, source.rig)
        for one, other in zip(images, source, strict=True):
            assert_same_image(one, other)


def test_monocular_images_are_read_back_without_a_right_image(tmp_path: Path) -> None:
    rig, images = depth_images(3, np.random.default_rng(3))
    from dataclasses import replace

    mono = [replace(image, depth=None) for image in images]
    write_recording(tmp_path / "m.mcap", MemorySource(Rig(rig.left), mono))
    with open_source(tmp_path / "m.mcap") as source:
        assert not source.rig.stereo
        for one, other in zip(mono, source, strict=True):
            assert_same_image(one, other)


def test_two_recordings_of_the_same_source_are_the_same_file(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        write_recording(tmp_path / name, MemorySource(fisheye_rig(), stereo_images(5, np.random.default_rng(4))))
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_chunks_stay_small_in_bytes_and_time(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    images = stereo_images(30, rng, (640, 480))
    rig = fisheye_rig(640, 480)
    write_recording(tmp_path / "a.mcap", MemorySource(rig, images), "raw")
    with (tmp_path / "a.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and len(summary.chunk_indexes) >= 5
    assert max(c.uncompressed_size for c in summary.chunk_indexes) <= CHUNK_BYTES
    assert max(c.message_end_time - c.message_start_time for c in summary.chunk_indexes) <= CHUNK_NS


def test_a_chunk_also_ends_by_the_wall_clock(tmp_path: Path) -> None:
    """A source slower than its stamps still loses at most half a second."""
    now = [0]
    with LogWriter(tmp_path / "a.mcap", clock=lambda: now[0]) as writer:
        for i in range(10):
            now[0] = i * 300_000_000
            writer.write(topics.LOG, foxglove.text(i, "INFO", "x"), i, i)
        size = writer.bytes_written
        assert size == (tmp_path / "a.mcap").stat().st_size
    with (tmp_path / "a.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and len(summary.chunk_indexes) == 5


def test_times_and_sequence_are_what_they_should_be(tmp_path: Path) -> None:
    images = stereo_images(4, np.random.default_rng(6))
    write_recording(tmp_path / "a.mcap", MemorySource(fisheye_rig(), images))
    with LogReader(tmp_path / "a.mcap") as reader:
        records = list(reader.messages([topics.LEFT_IMAGE]))
        assert [r.log_time for r in records] == [image.stamp_ns for image in images]
        assert [r.sequence for r in records] == [image.frame_id for image in images]
        assert all(r.publish_time > 1_600_000_000_000_000_000 for r in records)
        assert reader.stamps(topics.LEFT_IMAGE).tolist() == [image.stamp_ns for image in images]
        assert reader.metadata("stereo_sfm")["source"] == "memory"
        assert b"numpy" in (reader.attachment("versions.txt") or b"")
        assert reader.truncated == ""


def test_every_topic_written_is_in_the_table() -> None:
    with pytest.raises(ValueError, match="table of topics"):
        LogWriter(Path("/dev/null"), overwrite=True).write("/nowhere", foxglove.text(0, "INFO", "x"), 0)
    names = [t.name for t in topics.TABLE]
    assert len(names) == len(set(names))


def test_a_part_by_time_has_its_samples(tmp_path: Path) -> None:
    images = stereo_images(40, np.random.default_rng(7))
    write_recording(tmp_path / "a.mcap", MemorySource(fisheye_rig(), images))
    start, until = START_NS + 10 * PERIOD_NS, START_NS + 20 * PERIOD_NS
    with open_source(tmp_path / "a.mcap") as source:
        assert isinstance(source, McapSource)
        part = list(source.frames(start, until))
    assert [p.stamp_ns for p in part] == [image.stamp_ns for image in images[10:21]]
    for one, other in zip(images[10:21], part, strict=True):
        assert_same_image(one, other)


@pytest.mark.parametrize("late_ns", [-10 * PERIOD_NS, 3600 * 10**9, -START_NS // 2])
def test_samples_of_another_clock_cost_no_image(late_ns: int, tmp_path: Path) -> None:
    images = [
        image if image.imu is None else replace(image, imu=image.imu.shifted(late_ns))
        for image in stereo_images(40, np.random.default_rng(7))
    ]
    assert sum(image.imu is not None for image in images) > 20
    write_recording(tmp_path / "a.mcap", MemorySource(fisheye_rig(), images))
    with open_source(tmp_path / "a.mcap") as source:
        for one, other in zip(images, source, strict=True):
            assert_same_image(one, other)


def test_an_existing_file_is_not_overwritten_by_default(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(StereoSfmError, match="--overwrite"):
        LogWriter(path)
    assert path.read_bytes() == b"precious"
    LogWriter(path, overwrite=True).close()
    with LogReader(path) as reader:
        assert reader.topics == [] and reader.time_range == (0, 0)


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StereoSfmError, match="cannot write"):
        LogWriter(tmp_path / "file" / "a.mcap")
