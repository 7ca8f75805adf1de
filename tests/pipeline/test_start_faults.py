"""Processes that a signal stops while a run starts: main neither waits for them without end nor at its own end."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from typing import Any

import pytest

from stereo_sfm.pipeline import fork_server
from stereo_sfm.pipeline.child import Report
from stereo_sfm.pipeline.stage_processes import StageProcesses
from stereo_sfm.pipeline.watchdog import Heartbeat

END_S = 60.0  # the computer may be busy and the fork server loads its code; without the remedy it is never


def _body(to_main: Report, control: Any) -> None:
    to_main.send(control.recv())


def _first(stages: StageProcesses, stage: str) -> object:
    report = stages.report_of(stage)
    while isinstance(message := report.recv(), Heartbeat):
        pass
    return message


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_a_fork_server_that_was_stopped(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(fork_server, "SILENT_S", 0.3)
    stages = StageProcesses(1)
    server = fork_server._helpers()[0]  # pyright: ignore[reportPrivateUsage]
    assert server is not None
    os.kill(server, number)
    begin = time.monotonic()
    with caplog.at_level(logging.WARNING):
        try:
            stages.spawn("one", _body)
            stages.request("one", "hello")
            assert _first(stages, "one") == "hello"
        finally:
            stages.close({"one"})
    assert time.monotonic() - begin < END_S
    assert ("was stopped by a signal: it is continued" in caplog.text) == (number == signal.SIGSTOP)


def test_a_stage_that_reads_nothing_blocks_neither_requests_nor_the_end() -> None:
    stages = StageProcesses(1)
    try:
        stages.spawn("one", _body)
        pid = stages.pids["one"]
        os.kill(pid, signal.SIGSTOP)
        begin = time.monotonic()
        stages.request("one", bytes(10_000_000))
        assert time.monotonic() - begin < 1.0
        server = fork_server._helpers()[0]  # pyright: ignore[reportPrivateUsage]
        assert server is not None
        os.kill(server, signal.SIGSTOP)  # it tells of the end of the stages
    finally:
        begin = time.monotonic()
        stages.close(set())
    assert time.monotonic() - begin < END_S


def test_giving_up_ends_a_start_that_waits_for_the_fork_server() -> None:
    stages = StageProcesses(1)
    server = fork_server._helpers()[0]  # pyright: ignore[reportPrivateUsage]
    assert server is not None
    os.kill(server, signal.SIGSTOP)
    threading.Timer(0.5, stages.give_up).start()
    begin = time.monotonic()
    try:
        with pytest.raises(KeyboardInterrupt):
            stages.spawn("one", _body)
        assert time.monotonic() - begin < fork_server.SILENT_S  # before the watcher of the start does anything
        with pytest.raises(KeyboardInterrupt):
            stages.spawn("two", _body)
    finally:
        stages.close(set())
