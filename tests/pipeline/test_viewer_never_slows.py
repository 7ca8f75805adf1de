"""A slow, hanging or closed viewer loses images and does not slow the run."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import psutil
import pytest

from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.pipeline import processes
from stereo_sfm.pipeline import viewer as viewer_process
from stereo_sfm.pipeline.channels import DroppingOutbox, Inbox, Outbox
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.pipeline.viewer import ViewerOptions
from tests.pipeline.test_pipeline import CONFIG, SlidingWall, inline, same

__all__ = ["inline"]  # a fixture

FRAMES = 80  # those of `inline`


def hanging_viewer(to_main: Outbox, control: Connection, messages: Connection, options: ViewerOptions) -> None:
    """Takes its first message and never another."""
    Inbox[object](control).take()
    Inbox[object](messages).take()
    time.sleep(600)


def slow_viewer(to_main: Outbox, control: Connection, messages: Connection, options: ViewerOptions) -> None:
    """Takes a message every tenth of a second."""
    Inbox[object](control).take()
    for _ in range(20):
        Inbox[object](messages).take()
        time.sleep(0.1)
    os._exit(0)  # and is closed by its user


@pytest.mark.parametrize("body", [hanging_viewer, pytest.param(slow_viewer, marks=pytest.mark.slow)])
def test_the_run_is_complete_whatever_the_viewer_does(
    body: object, inline: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viewer_process, "run_viewer", body)
    monkeypatch.setattr(processes, "VIEWER_GRACE_S", 0.5)
    log, viewer = LogOptions(tmp_path / "run.mcap", "none"), ViewerOptions("save", tmp_path / "run.rrd")
    with ProcessRun(MadeSource.of(SlidingWall, FRAMES), CONFIG, log=log, viewer=viewer) as run:
        pids = run.pids
        assert len(list(run)) == FRAMES
    assert same(inline, tmp_path / "run.mcap") == []
    assert not any(psutil.pid_exists(pid) for pid in pids.values())


@pytest.mark.slow
def test_a_killed_viewer_does_not_stop_the_run(inline: Path, tmp_path: Path) -> None:
    log, viewer = LogOptions(tmp_path / "run.mcap", "none"), ViewerOptions("save", tmp_path / "run.rrd")
    seen = 0
    with ProcessRun(MadeSource.of(SlidingWall, FRAMES), CONFIG, log=log, viewer=viewer) as run:
        for seen, _ in enumerate(run, 1):
            if seen == 20:
                os.kill(run.pids["viewer"], signal.SIGKILL)
    assert seen == FRAMES
    assert same(inline, tmp_path / "run.mcap") == []


@pytest.mark.parametrize("closed", [False, True])
def test_sending_without_a_receiver_takes_no_time_and_no_memory(closed: bool) -> None:
    receive, send = multiprocessing.Pipe(duplex=False)
    outbox = DroppingOutbox(send, limit=16)
    if closed:
        receive.close()
    picture = np.zeros((400, 424), np.uint8)
    times: list[float] = []
    for k in range(500):
        begin = time.perf_counter()
        outbox.send((k, picture))
        times.append(time.perf_counter() - begin)
    assert np.median(times) < 1e-3
    assert len(outbox._waiting) <= 16
    if not closed:
        got = [receive.recv()[0]]
        while got[-1] != 499:  # the newest comes in the end
            got.append(receive.recv()[0])
        assert len(got) <= 16 + 2 and got == sorted(got)  # and one or two were in the pipe before
        receive.close()
    outbox.close()
    assert outbox.join(5)
