"""Which process goes first beside a live camera."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable

import pytest

from stereo_sfm.pipeline.child import LOWEST_PRIORITY, NICENESS, RAISED, raise_priority

ASK = "import os, sys; from stereo_sfm.pipeline.child import lower_priority; lower_priority(sys.argv[1])"


@pytest.mark.skipif(not hasattr(os, "getpriority"), reason="POSIX")
@pytest.mark.parametrize("stage", ["tracker", "optimizer"])
def test_stages_behind_the_pose_give_way_to_it(stage: str) -> None:
    ask = f"{ASK}; print(os.getpriority(os.PRIO_PROCESS, 0))"
    found = int(subprocess.run([sys.executable, "-c", ask, stage], capture_output=True, text=True, check=True).stdout)
    own = os.getpriority(os.PRIO_PROCESS, 0)
    assert found == min(own + {"tracker": 0, "optimizer": NICENESS["optimizer"]}[stage], LOWEST_PRIORITY)


def in_a_thread(work: Callable[[], int]) -> int:
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(work()))
    thread.start()
    thread.join()
    return found[0]


def test_who_may_not_raise_a_priority_keeps_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: int) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "setpriority", refuse)
    raise_priority()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="root may raise a priority")
def test_the_priority_of_a_thread_is_that_of_what_it_starts_and_of_nothing_else() -> None:
    own = os.getpriority(os.PRIO_PROCESS, 0)

    def raised() -> int:
        raise_priority()
        ask = "import os; print(os.getpriority(os.PRIO_PROCESS, 0))"
        return int(subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True).stdout)

    assert in_a_thread(raised) == min(own, RAISED)
    assert os.getpriority(os.PRIO_PROCESS, 0) == own == in_a_thread(lambda: os.getpriority(os.PRIO_PROCESS, 0))
