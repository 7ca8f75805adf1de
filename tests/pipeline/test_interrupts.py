"""A signal to the whole process group reaches main alone, also while its first child starts."""

from __future__ import annotations

import signal
import subprocess
import sys

SCRIPT = """
import signal
from stereo_sfm.pipeline.interrupts import ignored_by_children
from multiprocessing import resource_tracker
with ignored_by_children():
    resource_tracker.ensure_running()  # as the start of a process does: the first time it unblocks signals
    print(sorted(int(s) for s in signal.pthread_sigmask(signal.SIG_BLOCK, ())))
"""


def test_signals_stay_blocked_while_the_first_child_starts() -> None:
    out = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True).stdout
    assert {int(s) for s in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)} <= {
        int(s) for s in out.strip()[1:-1].split(",")
    }
