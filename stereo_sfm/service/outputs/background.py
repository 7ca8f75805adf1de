"""Commands of stereo-sfm as processes of low priority, for outputs that need what takes long to compute."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from collections.abc import Sequence

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.viz.server import end_with_parent

NICE = 10
LONGEST = 300  # letters of a reason


def run_command(arguments: Sequence[str], timeout_s: float) -> str:
    """What `stereo-sfm ARGUMENTS` prints.

    Raises:
        StereoSfmError: it failed, or took too long.
    """
    command = [sys.executable, "-m", "stereo_sfm.cli", *arguments]
    in_background = functools.partial(_in_background, os.getpid())
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, preexec_fn=in_background)
    except subprocess.TimeoutExpired:
        raise StereoSfmError(f"stereo-sfm {arguments[0]} took longer than {timeout_s:.0f} s") from None
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"it ended with {done.returncode}"]
        said = lines[-1].removeprefix(f"stereo-sfm {arguments[0]}: ")
        raise StereoSfmError(said[:LONGEST])
    return done.stdout


def _in_background(parent: int) -> None:
    """In the child."""
    os.nice(NICE)
    end_with_parent(parent)
