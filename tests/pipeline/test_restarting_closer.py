"""An error in the loop closer, or the end of its process, is reported, costs one keyframe its loop, and changes nothing
else in any wiring."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
from multiprocessing.connection import Connection
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
from stereo_sfm.pipeline.channels import Inbox, pickled
from stereo_sfm.pipeline.inline import run_inline
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.loop_link import LoopLink
from stereo_sfm.pipeline.processes import ProcessRun
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


# -- its process -------------------------------------------------------------------------------------------------------


def killed_step(self: LoopCloser, keyframe: Keyframe, step: Any = LoopCloser.step) -> LoopResult:
    """Ends the process in the middle of a step."""
    if keyframe.kf_id == FAILS_AT:
        os.kill(os.getpid(), signal.SIGKILL)
    return step(self, keyframe)


def run_killed_loop(*arguments: Any) -> None:
    ready: Any = workers.ready

    def then(*setup: Any) -> None:
        ready(*setup)  # it has keyframes of its own
        LoopCloser.step = killed_step  # type: ignore[method-assign]

    workers.ready = then
    workers.run_loop(*arguments)


def run_raising_loop(to_main: Any, control: Any, keyframes: Any) -> None:
    """A process whose error no closer catches."""
    taken: Any = Inbox.take

    def take(self: Any) -> Any:
        message = taken(self)
        if isinstance(message, Keyframe) and message.kf_id == FAILS_AT:
            raise MemoryError
        return message

    Inbox.take = take  # type: ignore[method-assign]
    workers.run_loop(to_main, control, keyframes)


@pytest.mark.parametrize(("body", "how"), [(run_killed_loop, "was killed by SIGKILL"), (run_raising_loop, "failed:")])
def test_a_process_that_ends_is_followed_by_another_with_the_keyframes_so_far(
    body: Any, how: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The bits are those of a run whose closer failed there, but for the reason of that keyframe's result."""
    a, b = tmp_path / "inline.mcap", tmp_path / "processes.mcap"
    with monkeypatch.context() as patch:
        patch.setattr(LoopCloser, "step", failing_step)
        inline_log(a, SlidingWall(FRAMES))
    monkeypatch.setattr("stereo_sfm.pipeline.stage_graph.workers.run_loop", body)
    record = RunRecord.of(CONFIG)
    with ProcessRun(MadeSource.of(SlidingWall, FRAMES), CONFIG, [record], log=LogOptions(b, "none")) as run:
        first = run.pids["loop"]
        assert len(list(run)) == FRAMES
        assert run.pids["loop"] != first
    assert f"the loop closer's process {how}" in caplog.text
    assert "it starts again" in caplog.text
    assert statistics(record, 1.0)["loop_errors_at"] == [FAILS_AT]
    assert [d for d in same(a, b) if "/loop" not in d] == []


def test_of_a_process_that_cannot_begin_again_every_keyframe_gets_a_result() -> None:
    """And a process that ends again before a result begins without what it knew."""
    (from_main, results), begun = multiprocessing.Pipe(duplex=False), list[Connection]()

    def begin() -> Connection:
        received, sent = multiprocessing.Pipe(duplex=False)
        begun.append(received)
        return sent

    def step(k: int) -> None:
        assert link.add(keyframe(k), pickled(keyframe(k))) == []
        result = LoopResult.without_loop(k, "no_candidate")
        link.answered(result, pickled(result))

    def died() -> list[int]:
        lost = link.died("process ended")
        for result in lost:
            assert result.failed
            link.answered(result, pickled(result))
        return [r.kf_id for r in lost]

    link = LoopLink(begin, results)
    assert not link.replaceable
    link.ready()
    for k in range(3):
        step(k)
    for k in (3, 4):
        link.add(keyframe(k), pickled(keyframe(k)))
    assert died() == [3]
    assert link.follow()
    known = begun[1].recv()
    assert [pickle.loads(data).kf_id for data in known.keyframes] == [0, 1, 2, 3]
    assert begun[1].recv().kf_id == 4
    link.ready()
    assert died() == [4]
    assert link.follow()
    assert begun[2].recv().keyframes == ()
    link.add(keyframe(5), pickled(keyframe(5)))
    assert died() == [5]  # not even ready
    assert not link.follow()
    assert [r.kf_id for r in link.add(keyframe(6), pickled(keyframe(6)))] == [6]
    for end in begun:
        end.close()
    link.close()
    assert [from_main.recv().kf_id for _ in range(6)] == list(range(6))
