"""Signals as a shell, `timeout` or a service manager sends them: to the whole group, at any time."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks import stopping
from stereo_sfm.commands._stop import StopRequest
from stereo_sfm.demo import demo_recording


@pytest.fixture
def _heard() -> Iterator[None]:
    """Processes that are started hear a closed terminal, whatever these tests run under (nohup)."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("_heard")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_waits_for_an_image_ends_cleanly(number: signal.Signals, tmp_path: Path) -> None:
    """Played so slowly that the second image never comes; `timeout` sends its signal to every process."""
    run = [sys.executable, "-m", "stereo_sfm.cli", "run", str(demo_recording()), "--speed", "0.00001"]
    options = ["-o", str(tmp_path / "run"), "--map-out", str(tmp_path / "map")]
    process = subprocess.Popen([*run, *options], start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        log = tmp_path / "run" / "run.mcap"
        while process.poll() is None and not (log.exists() and log.stat().st_size > 4096):
            time.sleep(0.1)
        time.sleep(1.0)
        os.killpg(process.pid, number)
        out, err = process.communicate(timeout=240)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130, err
    assert b"finishing" in err
    assert b"killed" not in err
    assert b"written to" in out
    assert (tmp_path / "run" / "report.md").exists()


@pytest.mark.slow
def test_a_run_ends_within_five_seconds_in_every_state() -> None:
    assert stopping.main([]) == 0


def test_under_nohup_a_closed_terminal_does_not_end_the_run() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopRequest() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.asked
            os.kill(os.getpid(), signal.SIGTERM)
            assert stop.asked
    finally:
        signal.signal(signal.SIGHUP, before)
