"""Files truncated anywhere, killed writers, full disks: complete parts are read, missing ones reported."""

from __future__ import annotations

import logging
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from stereo_sfm.cli import main
from stereo_sfm.commands import record as record_command
from stereo_sfm.drivers import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log import repair, topics
from stereo_sfm.log.reader import LogReader
from stereo_sfm.recording.describe import describe_file
from stereo_sfm.types import StereoImage
from tests.log.recordings import (
    PERIOD_NS,
    START_NS,
    MemorySource,
    assert_same_image,
    fisheye_rig,
    sequence_truth,
    stereo_images,
    write_recording,
)


class Whole(tuple[Path, list[StereoImage]]):
    """A file and its content, with a name that hypothesis can print."""

    def __repr__(self) -> str:
        return "a whole recording"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """A recording of 40 frames in about four chunks."""
    rng = np.random.default_rng(0)
    images = stereo_images(40, rng)
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    write_recording(path, MemorySource(fisheye_rig(), images, sequence_truth(30, rng)))
    return Whole((path, images))


def _first_images_end(path: Path) -> int:
    """Where the first chunk with images ends."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    (left,) = [c.id for c in summary.channels.values() if c.topic == topics.LEFT_IMAGE]
    chunk = next(c for c in summary.chunk_indexes if left in c.message_index_offsets)
    return chunk.chunk_start_offset + chunk.chunk_length


def _read(path: Path) -> list[StereoImage]:
    with open_source(path) as source:
        return list(source)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.floats(0.0, 1.0))
@example(cut=6e-5)  # shorter than a footer
def test_a_file_truncated_anywhere_gives_its_complete_frames(whole: Whole, tmp_path: Path, cut: float) -> None:
    path, images = whole
    data = path.read_bytes()
    short = tmp_path / "short.mcap"
    short.write_bytes(data[: int(cut * len(data))])
    if int(cut * len(data)) < _first_images_end(path):
        with pytest.raises(StereoSfmError, match=r"is empty|not an MCAP file|contains no images"):
            _read(short)
        return
    back = _read(short)
    for one, other in zip(images, back, strict=False):
        assert_same_image(one, other)
    mended = tmp_path / "mended.mcap"
    repair.recover(short, mended, overwrite=True)
    assert len(_read(mended)) == len(back)
    with mended.open("rb") as stream:  # every other reader of the format finds the same in the mended file
        reader = make_reader(stream, validate_crcs=True)
        counts = [channel.topic for _, channel, _ in reader.iter_messages()]
    with LogReader(short) as truncated:
        assert {t.topic: t.count for t in truncated.topics} == {t: counts.count(t) for t in set(counts)}
        times = [m.log_time for m in truncated.messages()]
        assert times == sorted(times)
        stamps = [m.log_time for m in truncated.messages([topics.LEFT_IMAGE])]
        assert truncated.stamps(topics.LEFT_IMAGE).tolist() == stamps


def test_a_truncated_file_is_reported(whole: Whole, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, images = whole
    short = tmp_path / "short.mcap"
    short.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 4])
    with caplog.at_level(logging.WARNING, "stereo_sfm"):
        back = _read(short)
    assert 15 < len(back) < len(images)
    (told,) = [text for record in caplog.records if "truncated" in (text := record.getMessage())]
    assert "messages recovered" in told


def test_recover_reports_what_was_missing(whole: Whole, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, _ = whole
    short, out = tmp_path / "short.mcap", tmp_path / "out.mcap"
    short.write_bytes(path.read_bytes()[:-3000])
    assert main(["recover", str(short), "-o", str(out)]) == 0
    assert "was not closed" in capsys.readouterr().out
    assert main(["recover", str(path), "-o", str(out), "--overwrite"]) == 0
    assert "nothing had to be repaired" in capsys.readouterr().out
    assert main(["diff", str(path), str(out)]) == 0
    assert main(["recover", str(path), "-o", str(out)]) == 2
    assert main(["recover", str(path), "-o", str(path), "--overwrite"]) == 2


def test_a_damaged_chunk_is_left_out_by_recover(whole: Whole, tmp_path: Path) -> None:
    path, images = whole
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes  # pyright: ignore[reportOptionalMemberAccess]
    data = bytearray(path.read_bytes())
    data[chunks[2].chunk_start_offset + 2000] ^= 0xFF
    bad, out = tmp_path / "bad.mcap", tmp_path / "out.mcap"
    bad.write_bytes(data)
    with pytest.raises(StereoSfmError, match="damaged"):
        _read(bad)
    found = repair.recover(bad, out)
    assert len(found.bad_chunks) == 1
    back = {image.frame_id: image for image in _read(out)}
    assert len(images) - 20 <= len(back) < len(images)
    for image in images:
        if image.frame_id in back:
            assert_same_image(image, back[image.frame_id])


def test_a_file_without_any_index_of_another_writer_is_read(whole: Whole) -> None:
    from io import BytesIO

    from mcap.writer import IndexType, Writer

    path, _ = whole
    with path.open("rb") as stream:
        records = list(make_reader(stream).iter_messages())
    for options in ({"index_types": IndexType.NONE, "repeat_channels": False, "use_statistics": False},
                    {"use_chunking": False}):  # fmt: skip
        out = BytesIO()
        writer = Writer(out, **options)
        writer.start()
        ids: dict[str, int] = {}
        for schema, channel, m in records:
            if channel.topic not in ids:
                assert schema is not None
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, "protobuf", schema_id)
            writer.add_message(ids[channel.topic], m.log_time, m.data, m.publish_time, m.sequence)
        writer.finish()
        other = path.parent / "other.mcap"
        other.write_bytes(out.getvalue())
        with LogReader(other) as reader:
            assert reader.truncated == ""
            assert [m.data for m in reader.messages()] == [m.data for _, _, m in records]
            assert len(reader.stamps(topics.LEFT_IMAGE)) == 40


_RECORDER = """
import sys, time
from pathlib import Path
sys.path.insert(0, {root!r})
import numpy as np
from stereo_sfm.recording.record import record
from stereo_sfm.drivers.memory import MemorySource
from tests.log.recordings import fisheye_rig, stereo_images

class Slow(MemorySource):
    live = True
    def __iter__(self):
        begin = time.monotonic()
        for i, image in enumerate(self.images):
            time.sleep(max(0.0, begin + i / 30 - time.monotonic()))
            print(image.stamp_ns, flush=True)
            yield image

images = stereo_images(150, np.random.default_rng(0))
for _ in record(Slow(fisheye_rig(), images), Path({path!r}), "png", overwrite=True):
    pass
"""


def test_a_killed_recording_loses_less_than_half_a_second(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    script = _RECORDER.format(root=str(Path(__file__).parents[2]), path=str(path))
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    last = 0
    for last in map(int, process.stdout):
        if last > START_NS + 40 * PERIOD_NS:
            break
    process.send_signal(signal.SIGKILL)
    process.wait()
    back = _read(path)
    assert back and last - back[-1].stamp_ns <= 500_000_000
    images = stereo_images(150, np.random.default_rng(0))
    for one, other in zip(images, back, strict=False):
        assert_same_image(one, other)


@pytest.mark.parametrize("limit", [20_000, 70_001, 150_003, 400_007])
@pytest.mark.usefixtures("whole")  # what is compiled for a recording is on the disk already
def test_a_full_disk_stops_with_one_line_and_leaves_a_closed_file(tmp_path: Path, limit: int) -> None:
    images = stereo_images(60, np.random.default_rng(8))
    path = tmp_path / "full.mcap"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        with pytest.raises(StereoSfmError, match=r"recording stopped, File too large: .* is closed and readable"):
            write_recording(path, MemorySource(fisheye_rig(), images))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.stat().st_size <= limit
    with LogReader(path) as reader:
        assert reader.truncated == ""  # closed properly
    with path.open("rb") as stream:
        assert make_reader(stream).get_summary() is not None
    if limit > 100_000:
        back = _read(path)
        assert len(back) > 3
        for one, other in zip(images, back, strict=False):
            assert_same_image(one, other)


def test_no_room_for_the_index_gives_up_chunks_for_it(tmp_path: Path, whole: Whole) -> None:
    """The disk may be so full that the last whole chunk leaves no room behind it."""
    path, _ = whole
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes  # pyright: ignore[reportOptionalMemberAccess]
    short = tmp_path / "short.mcap"
    end = chunks[-1].chunk_start_offset
    short.write_bytes(path.read_bytes()[:end])
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (end + 100, hard))
    try:
        repair.finish_in_place(short)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    with LogReader(short) as reader:
        assert reader.truncated == ""
        assert len(reader.summary.chunk_indexes) == len(chunks) - 2


class _Interrupted(MemorySource):
    """Sends a signal to this process at the tenth frame."""

    number = signal.SIGINT

    def __iter__(self) -> Iterator[StereoImage]:
        for i, image in enumerate(self.images):
            if i == 10:
                os.kill(os.getpid(), self.number)
            yield image


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_recording_is_closed(
    tmp_path: Path, number: signal.Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first Ctrl-C or SIGTERM finishes the file; for a device that is the usual end."""
    source = _Interrupted(fisheye_rig(), stereo_images(30, np.random.default_rng(1)))
    source.number = number
    path = tmp_path / "a.mcap"
    options = record_command.RecordOptions(str(path), "png", overwrite=True, quiet=False)
    for source.live, code in ((False, 130), (True, 0)):
        assert record_command.write(source, path, options, "record") == code
        assert "11 frames" in capsys.readouterr().out
        with LogReader(path) as reader:
            assert reader.truncated == ""
        assert len(_read(path)) == 11
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=st.lists(st.tuples(st.floats(-0.03, 1.0), st.integers(0, 255)), min_size=1, max_size=4))
def test_changed_bytes_give_the_right_frames_or_one_line(
    whole: Whole, tmp_path: Path, changes: list[tuple[float, int]]
) -> None:
    """Checksums cover the pixels, the index, the calibration and the ground truth: damage is always detected."""
    path, images = whole
    data = bytearray(path.read_bytes())
    for where, value in changes:  # negative: near the end, where the index is
        data[int(where * (len(data) - 1))] = value
    bad, out = tmp_path / "bad.mcap", tmp_path / "out.mcap"
    bad.write_bytes(data)
    by_id = {image.frame_id: image for image in images}
    for candidate in (bad, out):
        message = _use(candidate, bad, out, by_id)
        assert "\n" not in message
        if message:
            return


def _use(path: Path, damaged: Path, mended: Path, by_id: dict[int, StereoImage]) -> str:
    """Read, describe and recover; returns the error, if any."""
    try:
        for image in _read(path):
            assert_same_image(by_id[image.frame_id], image)
        describe_file(path)
        repair.recover(damaged, mended)
    except StereoSfmError as error:
        return str(error)
    return ""


def test_a_damaged_attachment_is_left_out_and_the_rig_can_be_given(
    whole: Whole, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, images = whole
    data = path.read_bytes()
    at = data.index(b"kannala_brandt")
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(data[:at] + b"K" + data[at + 1 :])
    with caplog.at_level(logging.WARNING, "stereo_sfm"), pytest.raises(StereoSfmError, match="give one with --rig"):
        _read(bad)
    assert "calibration.yaml is damaged (its checksum is wrong)" in caplog.text
    with open_source(bad, rig=fisheye_rig()) as source:
        assert len(list(source)) == len(images)


def test_a_damaged_index_is_made_again(whole: Whole, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, images = whole
    data = bytearray(path.read_bytes())
    data[-400] ^= 1
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(data)
    with caplog.at_level(logging.WARNING, "stereo_sfm"):
        assert len(_read(bad)) == len(images)
    assert "its index is damaged" in caplog.text
