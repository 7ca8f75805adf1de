"""Slow and full disks, unresponsive processes: the pose comes first, faults are reported, every run ends quickly."""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path

import psutil
import pytest

from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log import topics
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.recorded import ended_early, read_run
from stereo_sfm.messages import LogEnded
from stereo_sfm.pipeline import child, logger, workers
from stereo_sfm.pipeline.capture import TRACKER_SLOTS, FreeSlots
from stereo_sfm.pipeline.channels import Inbox
from stereo_sfm.pipeline.child import Report, Setup
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.pipeline.stage_processes import raise_file_limit
from stereo_sfm.pipeline.watchdog import SILENT_S, Watchdog
from stereo_sfm.types import Dropped
from tests.pipeline.test_pipeline import CONFIG, SlidingWall, all_end, inline, same

__all__ = ["inline"]  # a fixture

END_S = 30.0  # a quiet machine takes 5 at most (benchmarks/stopping.py), what never ends takes minutes


class Kept:
    """A sink that collects all messages but poses."""

    def __init__(self) -> None:
        self.drops: list[Dropped] = []
        self.ended: list[LogEnded] = []

    def put(self, message: object) -> None:
        if isinstance(message, Dropped):
            self.drops.append(message)
        elif isinstance(message, LogEnded):
            self.ended.append(message)


def closed(path: Path) -> bool:
    with LogReader(path) as reader:
        return reader.truncated == ""


def pause(pid: int, seconds: float) -> None:
    """Stop a process, and let it go on later."""
    os.kill(pid, signal.SIGSTOP)
    threading.Timer(seconds, os.kill, (pid, signal.SIGCONT)).start()


# -- the log gives way ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_stopped_logger_loses_logged_images_and_no_pose(tmp_path: Path) -> None:
    path, kept, frames = tmp_path / "run.mcap", Kept(), 40
    source = MadeSource.of(SlidingWall, frames, slow_s=0.1)
    with ProcessRun(source, CONFIG, [kept], realtime=True, log=LogOptions(path, "raw")) as run:
        for k, _ in enumerate(run):
            if k == 5:
                pause(run.pids["logger"], 2.0)
    left_out = [d.frame_id for d in kept.drops if d.where == "log"]
    assert [d for d in kept.drops if d.where == "ring"] == []
    assert 5 <= len(left_out) <= 20
    with LogReader(path) as reader:
        tracked = {r.sequence for r in reader.messages([topics.FRAME])}
        logged = {r.sequence for r in reader.messages([topics.LEFT_IMAGE])}
        assert tracked == set(range(frames))
        assert logged == tracked - set(left_out)
        assert [d.frame_id for d in read_run(reader).dropped] == left_out
        assert not ended_early(reader)


@pytest.mark.slow
def test_in_lockstep_the_run_waits_for_the_logger_and_reports_it(
    inline: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with ProcessRun(MadeSource.of(SlidingWall, 80), CONFIG, log=LogOptions(tmp_path / "run.mcap", "none")) as run:
        for k, _ in enumerate(run):
            if k == 10:
                pause(run.pids["logger"], SILENT_S + 2)
    assert same(inline, tmp_path / "run.mcap") == []
    assert "the logger has not responded" in caplog.text and "the logger responds again" in caplog.text


def full_disk(
    to_main: Report, control: Connection, messages: Connection, release: Connection, options: LogOptions
) -> None:
    """The logger on a disk with 300 kB."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
    REAL_LOGGER(to_main, control, messages, release, options)


def dying(to_main: Report, control: Connection, messages: Connection, release: Connection, options: LogOptions) -> None:
    """The logger, killed after a second."""
    threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGKILL)).start()
    REAL_LOGGER(to_main, control, messages, release, options)


REAL_LOGGER = logger.run_logger


@pytest.mark.parametrize(
    ("body", "why"), [(full_disk, "recording stopped, File too large"), (dying, "was killed by SIGKILL")]
)
def test_a_live_run_goes_on_without_its_log(
    body: object, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(logger, "run_logger", body)
    path, kept, frames = tmp_path / "run.mcap", Kept(), 40
    source = MadeSource.of(SlidingWall, frames, slow_s=0.06)
    with ProcessRun(source, CONFIG, [kept], realtime=True, log=LogOptions(path, "raw")) as run:
        assert len(list(run)) + sum(d.where == "ring" for d in kept.drops) == frames
    (ended,) = kept.ended
    assert why in ended.why and "the run continues without it" in caplog.text
    assert closed(path)


def test_files_are_processed_to_the_end_though_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logger, "run_logger", full_disk)
    path, kept = tmp_path / "run.mcap", Kept()
    with ProcessRun(MadeSource.of(SlidingWall, 30), CONFIG, [kept], log=LogOptions(path, "raw")) as run:
        assert len(list(run)) == 30
    assert len(kept.ended) == 1 and closed(path)


def test_the_tracker_keeps_its_slots_whatever_the_log_does() -> None:
    ends = [multiprocessing.Pipe(duplex=False) for _ in "ab"]
    (from_tracker, tracker), (from_log, log) = ends
    slots = FreeSlots(8, from_tracker, from_log)
    taken = [slots.take(block=False) for _ in range(8)]
    assert [t[1] for t in taken if t is not None] == [True] * (8 - TRACKER_SLOTS) + [False] * TRACKER_SLOTS
    assert slots.take(block=False) is None
    for k in range(8):
        tracker.send(k)
    assert slots.take(block=False) == (8 - TRACKER_SLOTS, False)  # the log still has its own
    log.send(0)
    assert [slots.take(block=False) for _ in range(4)] == [(5, True), (6, False), (7, False), (0, False)]
    log.close()  # it died: what it held is free
    tracker.send(0)
    free = [slots.take(block=False) for _ in range(5)]
    assert {t for t in free if t is not None} == {(k, False) for k in range(4)} and None in free


def test_with_files_the_log_is_complete() -> None:
    (from_tracker, _tracker), (from_log, _log) = [multiprocessing.Pipe(duplex=False) for _ in "ab"]
    slots = FreeSlots(8, from_tracker, from_log)
    assert [slots.take(block=True) for _ in range(8)] == [(k, True) for k in range(8)]


# -- who does not answer -------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["tracker", "mapper", "capture", "logger"])
def test_a_stopped_process_is_named_and_the_run_ends_in_time(
    stage: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "run.mcap"
    source = MadeSource.of(SlidingWall, 5000, slow_s=0.02)
    begin = 0.0

    def wait_and_stop() -> None:
        nonlocal begin
        until = time.monotonic() + 4 * SILENT_S
        while f"the {stage} has not responded" not in caplog.text and time.monotonic() < until:
            time.sleep(0.1)
        begin = time.monotonic()
        run.stop()

    with ProcessRun(source, CONFIG, realtime=True, log=LogOptions(path, "none")) as run:
        for k, _ in enumerate(run):
            if k == 10:
                os.kill(run.pids[stage], signal.SIGSTOP)
                threading.Thread(target=wait_and_stop).start()
    assert f"the {stage} has not responded" in caplog.text and "stopped by a signal" in caplog.text
    assert time.monotonic() - begin < END_S
    assert closed(path)


def hanging_loop(to_main: Report, control: Connection, keyframes: Connection) -> None:
    """A loop closer that never responds."""
    Inbox[Setup](control).take()
    to_main.send(child.Ready("loop"))
    Inbox[object](keyframes).take()
    time.sleep(600)


@pytest.mark.parametrize("second_signal", [False, True])
def test_a_hanging_stage_blocks_neither_the_end_nor_the_log(
    second_signal: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "run_loop", hanging_loop)
    path = tmp_path / "run.mcap"
    run = ProcessRun(MadeSource.of(SlidingWall, 5000, slow_s=0.01), CONFIG, log=LogOptions(path, "none"))
    begin = 0.0
    try:
        with run:
            for k, _ in enumerate(run):
                if k == 12:
                    begin = time.monotonic()
                    run.stop()
                    if second_signal:
                        raise KeyboardInterrupt
    except KeyboardInterrupt:
        assert second_signal
    assert time.monotonic() - begin < END_S
    assert all_end(run.pids)
    assert closed(path)
    with LogReader(path) as reader:
        assert ended_early(reader)


def never() -> SlidingWall:
    """A source whose device does not respond."""
    time.sleep(600)
    return SlidingWall(1)


def test_a_stop_while_the_source_is_opened_ends_the_run() -> None:
    run, begin = ProcessRun(MadeSource.of(never), CONFIG), time.monotonic()
    threading.Timer(0.2, run.stop).start()
    with pytest.raises(KeyboardInterrupt), run:
        pass
    assert time.monotonic() - begin < END_S


def late() -> SlidingWall:
    """A source that takes a while to open."""
    time.sleep(0.5)
    return SlidingWall(5000, slow_s=0.01)


def test_a_stop_shortly_before_the_source_is_open_ends_the_run_at_its_first_image() -> None:
    run, begin = ProcessRun(MadeSource.of(late), CONFIG), time.monotonic()
    threading.Timer(0.2, run.stop).start()
    with run:
        assert len(list(run)) <= 1
    assert time.monotonic() - begin < END_S


def test_a_computing_process_is_responsive(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr("stereo_sfm.pipeline.watchdog.SILENT_S", 1.0)
    context = multiprocessing.get_context("spawn")
    busy = context.Process(target=compute, args=(600.0,), daemon=True)
    busy.start()
    assert busy.pid is not None
    while psutil.Process(busy.pid).cpu_times().user < 0.3:
        time.sleep(0.05)
    watchdog = Watchdog({"mapper": busy.pid}, told.append)
    for _ in range(15):  # longer than an overloaded computer lets it wait
        time.sleep(0.2)
        watchdog.silent(["mapper"])
    assert told == []
    os.kill(busy.pid, signal.SIGSTOP)
    time.sleep(1.5)
    assert watchdog.silent(["mapper"]) == ["mapper"] == watchdog.silent(["mapper"])
    (message,) = told
    assert message.startswith("the mapper has not responded") and message.endswith(": stopped by a signal")
    os.kill(busy.pid, signal.SIGCONT)
    time.sleep(0.5)
    assert watchdog.silent(["mapper"]) == []
    assert told[1].startswith("the mapper responds again")
    busy.kill()
    busy.join()


def compute(seconds: float) -> None:
    """Without a word."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        sum(range(1000))


# -- limits of the system ------------------------------------------------------------------------------------------


def test_too_few_open_files_are_raised_or_named(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "setrlimit", lambda _, limits: asked.append(limits))
    monkeypatch.setattr(resource, "getrlimit", lambda _: (40, 4096))
    raise_file_limit(128)
    assert asked == [(128, 4096)]
    monkeypatch.setattr(resource, "getrlimit", lambda _: (40, 40))
    with pytest.raises(StereoSfmError, match="only 40 files may be open, a run needs 128: raise 'ulimit -n'"):
        raise_file_limit(128)
