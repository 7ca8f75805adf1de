"""Signals as a shell, `timeout` or a service manager sends them: to the whole group, at any time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stereo_sfm.demo import demo_recording


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_waits_for_an_image_ends_cleanly(number: signal.Signals, tmp_path: Path) -> None:
    """Played so slowly that the second image never comes; `timeout` sends its signal to every process."""
    run = [sys.executable, "-m", "stereo_sfm.cli", "run", str(demo_recording()), "--speed", "0.00001"]
    options = ["-o", str(tmp_path / "run"), "--map-out", str(tmp_path / "map")]
    process = subprocess.Popen([*run, *options], start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    log, begin = tmp_path / "run" / "run.mcap", time.monotonic()
    while not (log.exists() and log.stat().st_size > 4096) and time.monotonic() - begin < 100:
        time.sleep(0.1)
    time.sleep(1.0)
    os.killpg(process.pid, number)
    out, err = process.communicate(timeout=240)
    assert process.returncode == 130, err
    assert b"finishing" in err
    assert b"killed" not in err
    assert b"written to" in out
    assert (tmp_path / "run" / "report.md").exists()
