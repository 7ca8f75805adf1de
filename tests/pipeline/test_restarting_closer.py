"""An error in the loop closer is reported, costs one keyframe its loop, and changes nothing in any wiring."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.eval.statistics import loop_errors, statistics
from stereo_sfm.log import schema, topics
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.recorded import read_run
from stereo_sfm.loop.closer import LoopCloser
from stereo_sfm.pipeline import workers
from stereo_sfm.pipeline.inline import run_inline
from stereo_sfm.pipeline.restarting_closer import RestartingCloser
from stereo_sfm.pipeline.schedule import Recorded
from stereo_sfm.types import Keyframe, LoopResult
from tests.pipeline.test_pipeline import CONFIG, SlidingWall, inline_log, process_log, same

FAILS_AT = 3  # kf_id
FRAMES = 80


def failing_step(self: LoopCloser, keyframe: Keyframe, step: Any = LoopCloser.step) -> LoopResult:
    """Fails in the middle of a step, when the graph knows the keyframe already."""
    result: LoopResult = step(self, keyframe)
    if keyframe.kf_id == FAILS_AT:
        raise IndexError("list index out of range")
    return result


def run_failing_loop(*arguments: Any) -> None:
    """The body of the loop closer's process, whose closer fails."""
    LoopCloser.step = failing_step  # type: ignore[method-assign]
    workers.run_loop(*arguments)


class ScriptedCloser:
    """Fails at some keyframes, by id; remembers what it was given."""

    made: list[ScriptedCloser]

    def __init__(self, fails_at: set[int], fails_to_add: set[int] | None = None) -> None:
        self.fails_at, self.fails_to_add = fails_at, fails_to_add or set()
        self.added, self.loops = list[int](), list[tuple[int, int]]()

    def step(self, keyframe: Keyframe) -> LoopResult:
        if keyframe.kf_id in self.fails_at:
            raise ValueError("a wrong value")
        self.added.append(keyframe.kf_id)
        k = keyframe.kf_id
        loop = LoopResult.without_loop(k, "no_candidate")
        if k == 2:  # sees keyframe 0 again, and 1 will not be named any more
            loop = LoopResult(2, 0, np.eye(4), np.eye(6), np.zeros((0, 2), np.int64), 9, 1.0, "")
            object.__setattr__(loop, "forgotten_kf_ids", np.array([1]))
        return loop

    def add(self, keyframe: Keyframe) -> None:
        if keyframe.kf_id in self.fails_to_add:
            raise ValueError("a wrong value")
        self.added.append(keyframe.kf_id)

    def add_loop(self, loop: LoopResult) -> None:
        self.loops.append((loop.candidate_kf_id, loop.kf_id))


def keyframe(k: int) -> Keyframe:
    none, uv = np.zeros(0, np.int64), np.zeros((0, 2))
    return Keyframe(k, k, k, np.eye(4), none, uv, uv.copy(), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))


def closers(fails_at: set[int], fails_to_add: set[int] | None = None) -> tuple[RestartingCloser, list[ScriptedCloser]]:
    made = list[ScriptedCloser]()

    def make() -> ScriptedCloser:
        made.append(ScriptedCloser(fails_at, fails_to_add))
        return made[-1]

    return RestartingCloser(make), made


def test_another_closer_goes_on_with_the_keyframes_and_loops_that_can_be_named() -> None:
    closer, made = closers({4})
    results = [closer.step(keyframe(k)) for k in range(6)]
    assert [r.kf_id for r in results] == list(range(6))
    assert [r.failed for r in results] == [False] * 4 + [True, False]
    assert results[4].reason == "error: ValueError"
    assert made[-1].added == [0, 2, 3, 4, 5]
    assert made[-1].loops == [(0, 2)]


def test_a_keyframe_that_no_closer_takes_is_left_out() -> None:
    closer, made = closers({4}, fails_to_add={4})
    results = [closer.step(keyframe(k)) for k in range(6)]
    assert [r.failed for r in results] == [False] * 4 + [True, False]
    assert made[-1].added == [0, 2, 3, 5]


def test_a_closer_that_fails_at_once_again_is_followed_by_an_empty_one() -> None:
    closer, made = closers({3, 4})
    results = [closer.step(keyframe(k)) for k in range(6)]
    assert [k for k, r in enumerate(results) if r.failed] == [3, 4]
    assert made[-1].added == [5]
    assert made[-1].loops == []


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LoopCloser, "step", failing_step)


def test_the_run_goes_on_and_says_it(failing: None, caplog: pytest.LogCaptureFixture) -> None:
    record = RunRecord.of(Config())
    assert len(list(run_inline(SlidingWall(FRAMES), CONFIG, [record]))) == FRAMES
    assert f"the loop closer failed at keyframe {FAILS_AT} (IndexError: list index out of range)" in caplog.text
    assert len(record.keyframes) > FAILS_AT + 1
    stats = statistics(record, 1.0)
    assert stats["loop_errors_at"] == [FAILS_AT]
    assert f"1 keyframe ({FAILS_AT})" in loop_errors(stats)


def test_inline_processes_and_replay_agree_across_an_error(
    failing: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    a, b, c = (tmp_path / f"{name}.mcap" for name in ("inline", "processes", "replay"))
    inline_log(a, SlidingWall(FRAMES))
    original = workers.run_loop
    monkeypatch.setattr("stereo_sfm.pipeline.stage_graph.workers.run_loop", run_failing_loop)
    frames = process_log(b, MadeSource.of(SlidingWall, FRAMES), delays=1)
    monkeypatch.setattr("stereo_sfm.pipeline.stage_graph.workers.run_loop", original)
    assert len(frames) == FRAMES
    assert same(a, b) == []
    with LogReader(b) as reader:
        run = read_run(reader)
        decode = schema.decoder(LoopResult, schema.schema_data(LoopResult))
        loops: list[LoopResult] = [decode(record.data) for record in reader.messages([topics.LOOP])]
    assert [loop.kf_id for loop in loops if loop.failed] == [FAILS_AT]
    inline_log(c, SlidingWall(FRAMES), schedule=Recorded(run.applied))
    assert same(a, c) == []
