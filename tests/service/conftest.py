"""What else runs on the computer of a service."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Generator

import pytest

BUSY = 8  # loops: four for each core of a small computer


@pytest.fixture(params=[0, BUSY], ids=["quiet", "busy"])
def beside(request: pytest.FixtureRequest) -> Generator[None]:
    """The test is run on a computer that does nothing else, and beside busy loops."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(request.param)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
