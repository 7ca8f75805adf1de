"""Five minutes of camera time with everything that goes wrong on a robot; `benchmarks soak` runs hours."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.soak import main, plan


def test_the_plan_has_every_fault_and_leaves_the_ends_alone() -> None:
    events, unplugged, dark = plan(9000, times=2, kills=1)
    assert len(unplugged) == len(dark) == 2 and {fault for _, fault in events} >= {"kill tracker", "stop mapper"}
    frames = [frame for frame, _ in events]
    assert frames == sorted(frames) and min(frames) >= 375 and max(frames) <= 8100


@pytest.mark.slow
def test_five_minutes_of_everything(tmp_path: Path) -> None:
    options = {"minutes": "5", "times": "2", "kills": "1", "source": "sim:loop?size=424x400&frames=300"}
    assert main([*(f"--{name}={value}" for name, value in options.items()), f"--work={tmp_path}"]) == 0
