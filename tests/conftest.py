"""Shared fixtures: one OpenCV thread, and where the real sequences are."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

import stereo_sfm  # noqa: F401  # before the libraries, which read its choice of machine code when they are loaded

# isort: split
import cv2
import pytest
from hypothesis import settings

cv2.setNumThreads(1)

# A service that is tested makes its token here, not in the user's own folder.
os.environ["XDG_STATE_HOME"] = _STATE = tempfile.mkdtemp(prefix="stereo-sfm-state")
atexit.register(shutil.rmtree, _STATE, ignore_errors=True)

# The same examples in every run; HYPOTHESIS_PROFILE=search looks for new ones.
settings.register_profile("same", derandomize=True)
settings.register_profile("search", derandomize=False, max_examples=500)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


def _data_root() -> Path | None:
    candidates = [os.environ.get("STEREO_SFM_DATA"), Path(__file__).parents[2] / "shared" / "data"]
    return next((Path(c) for c in candidates if c and Path(c).is_dir()), None)


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Folder of the real sequences; tests that need it are skipped where there is none."""
    root = _data_root()
    if root is None:
        pytest.skip("no real sequences here: set STEREO_SFM_DATA")
    return root
