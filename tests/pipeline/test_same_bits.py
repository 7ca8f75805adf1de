"""The contract: the same input gives the same log to the bit whatever the stages' timing, a loop closing inside."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def identical_runs(source: str, runs: int = 10) -> None:
    """Inline once, then as processes with random delays in every stage."""
    command = [sys.executable, "-m", "benchmarks", "same_bits", "--", source, "--runs", str(runs)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert f"identical {runs} of {runs}" in done.stdout, done.stdout + done.stderr
    loops = re.search(r"(\d+) loops closed", done.stdout)
    assert loops is not None
    assert int(loops[1]) > 0


@pytest.mark.slow
def test_simulated_loop() -> None:
    identical_runs("sim:loop?size=424x400&rate=10")


@pytest.mark.slow
def test_real_sequence(data_root: Path) -> None:
    identical_runs(str(data_root / "euroc_mh01"))
