"""Dataclasses cross the protobuf form with every bit, and other protobuf readers see the same numbers."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory

from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log import recorded, schema, topics
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.run_log import RunLog
from stereo_sfm.log.samples import ImageInfo, ImuSample
from stereo_sfm.log.track_stats import TrackStats
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.messages import Health, SourceCounters, StageTimes, Topic
from stereo_sfm.types import (
    F64,
    Applied,
    Corners,
    Dropped,
    Frame,
    Keyframe,
    LoopResult,
    MapUpdate,
    Observations,
    TrackState,
    shape,
)
from tests.log.recordings import fisheye_rig


def _observations(n: int, rng: np.random.Generator) -> Observations:
    right = rng.normal(size=(n, 2))
    right[::2] = np.nan
    age = rng.integers(0, 99, n).astype(np.int32)
    return Observations(rng.integers(0, 2**60, n), rng.normal(size=(n, 2)), right, age, rng.random(n) < 0.5)


def _messages(n: int, seed: int) -> list[object]:
    rng = np.random.default_rng(seed)
    frame = Frame(
        2**31 + 5, 10**18 + 7, rng.normal(size=(4, 4)), rng.normal(size=(6, 6)), TrackState.RECOVERED, "näher",
        _observations(n, rng), -1, rng.normal(size=(4, 4)), 3, True, {"z": 0.1, "a": float("inf")},
    )  # fmt: skip
    keyframe = Keyframe(
        n, 7, -5, rng.normal(size=(4, 4)), rng.integers(0, 9**9, n), rng.normal(size=(n, 2)), rng.normal(size=(n, 2)),
        rng.normal(size=(n, 3)), rng.integers(0, 256, (n, 32), np.uint8), 2,
        corners=Corners(
            rng.random((n, 2), np.float32), rng.random((n, 2), np.float32), rng.random((n, 3), np.float32),
            rng.integers(0, 256, (n, 32), np.uint8),
        ),
    )  # fmt: skip
    update = MapUpdate(
        1, 2, rng.integers(0, 9, n), rng.normal(size=(n, 4, 4)), rng.integers(0, 9, n), rng.normal(size=(n, 3)),
        rng.integers(0, 9, n), rng.integers(0, 9, (n, 2)), rng.normal(size=(4, 4)),
    )  # fmt: skip
    loop = LoopResult(
        4, -1, np.eye(4), rng.normal(size=(6, 6)), rng.integers(0, 9, (n, 2)), 0, 0.25, "too_few_inliers",
        tuple((i, 0.5 * i, f"r{i}") for i in range(n)),
    )  # fmt: skip
    return [frame, keyframe, update, loop, Dropped(3, 4, "ring", "full", 2), Applied(5, 6)]


def _assert_equal(a: object, b: object) -> None:
    for f in dataclasses.fields(a):  # pyright: ignore[reportArgumentType]
        x, y = getattr(a, f.name), getattr(b, f.name)
        if isinstance(x, np.ndarray):
            assert (x.dtype, x.shape) == (y.dtype, y.shape), f.name
            assert x.tobytes() == y.tobytes(), f.name
        elif dataclasses.is_dataclass(x):
            _assert_equal(x, y)
        else:
            assert x == y and type(x) is type(y), f.name


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 12), st.integers(0, 2**32 - 1))
def test_every_message_of_a_run_is_read_back_to_the_bit(n: int, seed: int) -> None:
    for message in _messages(n, seed):
        decode = schema.decoder(type(message), schema.schema_data(type(message)))
        _assert_equal(message, decode(schema.encode(message)))


def test_arrays_of_rows_have_their_shape() -> None:
    """A field of rows needs their shape in its metadata, or it would be read back flat."""
    for message in _messages(3, 0):
        for f in schema.fields_of(type(message)):
            value = getattr(message, f.name)
            if isinstance(value, np.ndarray) and value.ndim > 1:
                assert np.zeros(value.shape).reshape(f.shape).shape == value.shape, f.name


def test_other_readers_of_the_schema_see_the_same_numbers() -> None:
    frame = next(m for m in _messages(5, 1) if isinstance(m, Frame))
    record = Schema(1, schema.schema_data(Frame), "protobuf", "stereo_sfm.Frame")
    decode = DecoderFactory().decoder_for("protobuf", record)
    assert decode is not None
    seen = decode(schema.encode(frame))
    assert list(seen.odom_T_cam) == frame.odom_T_cam.ravel().tolist()
    assert list(seen.observations.point_ids) == frame.observations.point_ids.tolist()
    assert list(seen.observations.inlier) == frame.observations.inlier.tolist()
    assert list(seen.observations.age) == frame.observations.age.tolist()
    assert (seen.frame_id, seen.state, seen.reason) == (frame.frame_id, 3 - 1, "näher")
    assert dict(zip(seen.stats_names, seen.stats_values, strict=True)) == frame.stats


def test_flat_messages_round_trip() -> None:
    nan = float("nan")
    stats = TrackStats(1, 2, True, 3, 4, 5, 6, 0.5, 0.25, inliers=7.0, other={"x": 1.0})
    for message in (ImageInfo(1, 2, 3, 4.5, nan, 0, True, False, -1, 0), ImuSample(1, 2.0, 3.0, nan, 4.0, 5.0, 6.0),
                    stats, Health("track", 1, 30.0, 2, 1.0, 2.0, 3.0, 0)):  # fmt: skip
        decode = schema.decoder(type(message), schema.schema_data(type(message)))
        assert repr(decode(schema.encode(message))) == repr(message)  # repr: NaN equals itself


def test_a_log_of_an_older_version_has_the_defaults_of_new_fields() -> None:
    @dataclasses.dataclass
    class Dropped:  # as it may have been before `why` and `count` existed
        frame_id: int
        stamp_ns: int
        where: str
        why: str

    data, old = schema.encode(Dropped(1, 2, "ring", "full")), schema.schema_data(Dropped)
    from stereo_sfm.types import Dropped as Today

    assert schema.decoder(Today, old)(data) == Today(1, 2, "ring", "full", 1)


def test_a_log_without_a_needed_field_is_named() -> None:
    @dataclasses.dataclass
    class Applied:
        version: int

    data, old = schema.encode(Applied(1)), schema.schema_data(Applied)
    from stereo_sfm.types import Applied as Today

    with pytest.raises(StereoSfmError, match="before_frame_id"):
        schema.decoder(Today, old)(data)


def test_a_message_of_a_run_is_one_row_of_the_table() -> None:
    """Writer and reader use the classes of the table; every message has a row."""
    assert set(topics.OF) >= {type(m) for m in _messages(3, 0)} | {Health, StageTimes, SourceCounters}
    assert {row.schema: cls for cls, row in topics.OF.items()} == recorded.TYPES
    for cls, row in topics.OF.items():
        assert row.schema == f"stereo_sfm.{cls.__name__}" and topics.BY_NAME[row.name] is row
    applied = Applied(3, before_frame_id=7, stamp_ns=11)
    assert topics.OF[Applied].key(applied, 99) == (11, 7)
    assert topics.OF[StageTimes].key(StageTimes(5, {}), 99) == (99, 5)


@dataclass(frozen=True)
class Probe:
    """A message without a row."""

    frame_id: int
    stamp_ns: int
    points: F64 = field(metadata=shape(-1, 3))


def test_a_new_message_is_one_dataclass_and_one_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = topics.Row(Topic("/probe", "when asked"), Probe)
    monkeypatch.setitem(topics.OF, Probe, row)
    monkeypatch.setitem(topics.BY_NAME, row.name, row)
    monkeypatch.setitem(recorded.TYPES, row.schema, Probe)
    probe = Probe(4, 1_000_000_000, np.arange(6.0).reshape(2, 3))
    log = RunLog(
        LogWriter(tmp_path / "a.mcap"), fisheye_rig(), Config(), source="x", mode="inline", image_format="none"
    )
    log.put(probe)
    log.close()
    with LogReader(tmp_path / "a.mcap") as reader:
        ((record, back),) = recorded.messages(reader, ["/probe"])
    assert (record.log_time, record.sequence) == (probe.stamp_ns, 4)
    np.testing.assert_array_equal(back.points, probe.points)


def test_a_message_without_a_row_is_refused(tmp_path: Path) -> None:
    log = RunLog(
        LogWriter(tmp_path / "a.mcap"), fisheye_rig(), Config(), source="x", mode="inline", image_format="none"
    )
    with pytest.raises(TypeError, match="no topic for object"):
        log.put(object())
    log.close()
