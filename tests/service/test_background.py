"""Commands that outputs of the service run beside it."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.pipeline.watchdog import process_state
from stereo_sfm.service.outputs.background import run_command

LONG = (
    "from stereo_sfm.service.outputs.background import run_command; "
    "run_command(['record', 'sim:loop', '--max-frames', '100000', '-o', 'walk.mcap'], 300)"
)


def children(pid: int) -> list[int]:
    return [int(child) for tasks in Path(f"/proc/{pid}/task").glob("*/children") for child in tasks.read_text().split()]


def wait_for(what: str, ready: Callable[[], object], seconds: float = 30.0) -> None:
    until = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < until, what
        time.sleep(0.05)


@pytest.mark.usefixtures("beside")
@pytest.mark.skipif(sys.platform != "linux", reason="prctl")
def test_a_command_ends_with_the_process_that_waits_for_it(tmp_path: Path) -> None:
    """Also if that is killed: nobody would read what it prints."""
    waiting = subprocess.Popen([sys.executable, "-c", LONG], cwd=tmp_path)
    try:
        wait_for("the command starts", lambda: children(waiting.pid))
        (command,) = children(waiting.pid)
    finally:
        waiting.send_signal(signal.SIGKILL)
        waiting.wait()
    wait_for("the command ends", lambda: process_state(command) in ("", "Z"))


def test_a_command_ends_whose_starter_was_killed_before_it_could_be_watched() -> None:
    late = "import os; from stereo_sfm.viz.server import end_with_parent; end_with_parent(os.getppid() + {}); print(1)"
    done = [subprocess.run([sys.executable, "-c", late.format(k)], capture_output=True).stdout for k in (0, 1)]
    assert done == [b"1\n", b""]


def test_a_command_that_fails_says_why_from_its_beginning(tmp_path: Path) -> None:
    missing = tmp_path / ("long" * 60) / "walk.mcap"
    with pytest.raises(StereoSfmError, match=f"^no such file or folder: {re.escape(str(tmp_path))}") as raised:
        run_command(["info", str(missing)], 60)
    assert len(str(raised.value)) <= 300
