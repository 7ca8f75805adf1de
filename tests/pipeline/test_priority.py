"""Which process goes first beside a live camera."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from stereo_sfm.pipeline.child import LOWEST_PRIORITY, NICENESS

ASK = "import os, sys; from stereo_sfm.pipeline.child import lower_priority; lower_priority(sys.argv[1])"


@pytest.mark.skipif(not hasattr(os, "getpriority"), reason="POSIX")
@pytest.mark.parametrize("stage", ["tracker", "optimizer"])
def test_stages_behind_the_pose_give_way_to_it(stage: str) -> None:
    ask = f"{ASK}; print(os.getpriority(os.PRIO_PROCESS, 0))"
    found = int(subprocess.run([sys.executable, "-c", ask, stage], capture_output=True, text=True, check=True).stdout)
    own = os.getpriority(os.PRIO_PROCESS, 0)
    assert found == min(own + {"tracker": 0, "optimizer": NICENESS["optimizer"]}[stage], LOWEST_PRIORITY)
