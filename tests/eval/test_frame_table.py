"""What is kept of every frame of a run."""

from __future__ import annotations

import errno
import os

import numpy as np
import pytest

from stereo_sfm.eval.frame_table import FrameTable, TimeTable
from stereo_sfm.eval.record import LostInterval, RunRecord
from stereo_sfm.eval.spool import BLOCK
from stereo_sfm.messages import Health
from stereo_sfm.types import Frame, Keyframe, Observations, TrackState

NONE = np.zeros(0, np.int64)
SEEN = Observations(NONE, np.zeros((0, 2)), np.zeros((0, 2)), NONE.astype(np.int32), np.zeros(0, bool))
OK, LOST, RECOVERED = TrackState.OK, TrackState.LOST, TrackState.RECOVERED


def record_of(states: list[TrackState], reasons: list[str]) -> RunRecord:
    record = RunRecord()
    for k, (state, reason) in enumerate(zip(states, reasons, strict=True)):
        record.put(Frame(10 + k, k * 10**8, np.eye(4), np.eye(6), state, reason, SEEN, 0, np.eye(4)))
    return record


def test_many_frames_keep_their_values() -> None:
    table = FrameTable()
    for k in range(300):
        pose = np.full((4, 4), float(k))
        table.add(Frame(k, 7 * k, pose, np.eye(6), OK, ("", "dark", "blur")[k % 3], SEEN, k // 10, -pose))
    assert len(table) == 300 and table.frame_id.tolist() == list(range(300))
    assert (table.odom_T_cam[:, 2, 1] == np.arange(300)).all() and (table.kf_T_cam[:, 0, 0] == -np.arange(300)).all()
    assert table.reasons_of(np.array([1, 2, 3, 299])) == ["dark", "blur", "", "blur"]


def test_the_first_stamp_is_the_beginning() -> None:
    table = FrameTable()
    assert table.begin_ns == 0
    for k in (7, 8):
        table.add(Frame(k, 10 * k, np.eye(4), np.eye(6), OK, "", SEEN, 0, np.eye(4)))
    assert table.begin_ns == 70


def filled(count: int) -> FrameTable:
    table = FrameTable()
    for k in range(count):
        pose = np.full((4, 4), float(k))
        table.add(Frame(k, 7 * k, pose, np.eye(6), OK, "", SEEN, k // 10, -pose))
    return table


def assert_complete(table: FrameTable, count: int) -> None:
    assert len(table) == count and table.last("frame_id") == count - 1
    assert (table.frame_id == np.arange(count)).all() and (table.stamp_ns == 7 * np.arange(count)).all()
    assert (table.odom_T_cam[:, 0, 3] == np.arange(count)).all() and (table.kf[:, 2, 1] == -np.arange(count)).all()


def test_the_rows_of_a_long_run_wait_in_a_file() -> None:
    table = filled(3 * BLOCK + 5)
    held = [value for value in vars(table).values() if isinstance(value, np.ndarray)]
    assert [len(rows) for rows in held] == [BLOCK]
    assert_complete(table, 3 * BLOCK + 5)
    table.add(
        Frame(
            3 * BLOCK + 5,
            7 * (3 * BLOCK + 5),
            np.full((4, 4), 3.0 * BLOCK + 5),
            np.eye(6),
            OK,
            "",
            SEEN,
            0,
            np.full((4, 4), -3.0 * BLOCK - 5),
        )
    )
    assert_complete(table, 3 * BLOCK + 6)


def test_a_disk_that_refuses_loses_no_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first block is written in parts, the second only in part, the third not at all."""
    room = [int(1.5 * BLOCK) * 228]

    def pwrite(file: int, data: memoryview, at: int) -> int:
        taken = min(100_000, room[0], len(data))
        if not taken:
            raise OSError(errno.ENOSPC, "no space left on device")
        room[0] -= taken
        return real(file, data[:taken], at)

    real = os.pwrite
    monkeypatch.setattr(os, "pwrite", pwrite)
    assert_complete(filled(4 * BLOCK + 1), 4 * BLOCK + 1)


def test_lost_intervals_begin_after_the_first_pose() -> None:
    states = [TrackState.INITIALIZING, OK, LOST, LOST, RECOVERED, OK, LOST]
    record = record_of(states, ["dark", "", "blur", "dark", "", "", "dark"])
    assert record.lost_intervals() == [LostInterval(12, 2, 0.2, "blur", 0.2), LostInterval(16, 1, 0.0, "dark", 0.6)]
    assert record.tracked().tolist() == [False, True, False, False, True, True, False]
    assert record_of([LOST], ["dark"]).lost_intervals() == []


def test_times_are_of_the_frames_that_were_tracked() -> None:
    table = TimeTable()
    table.add(3, {"track": 4.0, "flow": 1.0})
    table.add(9, {"track": 7.0})  # a frame that never came
    table.add(5, {"track": 5.0})
    table.add(5, {"track": 6.0})  # a second time
    times = table.of_frames(np.array([3, 4, 5]))
    assert list(times) == ["track", "flow"]
    np.testing.assert_array_equal(times["track"], [4.0, np.nan, 6.0])
    np.testing.assert_array_equal(times["flow"], [1.0, np.nan, np.nan])
    assert TimeTable().of_frames(np.array([1, 2])) == {}


def test_health_keeps_the_last_word_and_the_worst() -> None:
    record = RunRecord()
    for stamp, p99, queue, dropped in ((1, 9.0, 1, 0), (2, 30.0, 5, 2), (3, 11.0, 0, 2)):
        record.put(Health("mapper", stamp, 10.0, queue, 5.0, 8.0, p99, dropped))
    (health,) = record.health.values()
    assert (health.p99_ms, health.queue, health.dropped) == (30.0, 5, 2)


def test_points_seen_are_counted_once() -> None:
    record = RunRecord()
    for kf_id, ids in enumerate(([1, 2, 3], [2, 3, 5000], [])):
        points, empty = np.array(ids, np.int64), np.zeros((len(ids), 2))
        record.put(
            Keyframe(
                kf_id, kf_id, kf_id, np.eye(4), points, empty, empty, np.zeros((len(ids), 3)),
                np.zeros((len(ids), 32), np.uint8),
            )
        )  # fmt: skip
    assert record.seen_points.sum() == 4
