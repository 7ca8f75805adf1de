"""Samples of IMU and wheels through every way of running: the same bits."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stereo_sfm.cli import main

SPEC = "sim:loop?size=212x200&rate=10&start=60&frames=32&imu=t265&wheel=differential&dark=8-8.5"


@pytest.mark.parametrize("live", [(), ("--realtime",)])
def test_a_run_over_processes_is_replayed_inline(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], live: tuple[str, ...]
) -> None:
    assert main(["run", SPEC, "-o", str(tmp_path / "run"), "-q", "--max-lost", "100", *live]) == 0
    capsys.readouterr()
    assert main(["replay", str(tmp_path / "run"), "-o", str(tmp_path / "again"), "--check", "--inline", "-q"]) == 0
    assert "identical" in capsys.readouterr().out
    states = json.loads((tmp_path / "run" / "stats.json").read_text())["states"]
    assert live or states["INERTIAL"] == 5  # the dark is bridged
