"""Five minutes of camera time with everything that goes wrong on a robot; `benchmarks soak` runs hours."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks._soak_attacks import ALONE, ATTACKS, DONE, LOOPS, Turns
from benchmarks.soak import RATE, Sizes, Watch, growth, judge_memory, main, plan


def test_the_plan_has_every_fault_and_leaves_the_ends_alone() -> None:
    events, unplugged, dark = plan(9000, times=2, kills=1)
    assert len(unplugged) == len(dark) == 2 and {fault for _, fault in events} >= {"kill tracker", "stop mapper"}
    frames = [frame for frame, _ in events]
    assert frames == sorted(frames) and min(frames) >= 375 and max(frames) <= 8100


def test_what_a_process_keeps_is_told_from_what_its_jobs_need() -> None:
    """Restarted after half an hour; then 100 MB and 3 MB an hour more, and now and then a job of 80 MB."""
    watch = Watch()
    for minute in range(0, 240, 2):
        hours = minute / 60
        kept = {"grows": int(100e6 + 3e6 * hours), "works": 100_000_000}
        most = {"grows": kept["grows"], "works": 100_000_000 + 80_000_000 * (minute % 14 == 0)}
        pids = {"grows": 1 + (minute > 30), "works": 3}
        watch.rss.append(Sizes(int(minute * 60 * RATE), kept, most, pids))
    found = growth(watch.rss)
    assert found["grows"][0].mb_h == pytest.approx(3.0, abs=1e-3) and found["grows"][2] == pytest.approx(2.93, abs=0.05)
    assert found["works"][0].mb_h == pytest.approx(0.0, abs=1e-9) and found["works"][1].mb >= 100.0
    assert judge_memory(watch) == ["grows grows by 3.0 MB an hour"]


@pytest.mark.parametrize(
    ("attacked", "said"),
    [
        ((0.02, 0.0, 0.01), []),
        ((0.30, 0.31, 0.32), ["31.00 % late with attacks, 1.00 without"]),
        ((0.01,), ["too few turns with poses: 3 alone, 1 with attacks"]),
    ],
    ids=["alike", "later", "too few"],
)
def test_turns_with_attacks_are_compared_with_turns_alone(
    attacked: tuple[float, ...], said: list[str], tmp_path: Path
) -> None:
    turns = Turns(tmp_path, 0, 0, 0)
    (tmp_path / DONE).write_text("guesses 1\n")
    for kind, shares in ((ALONE, (0.0, 0.02, 0.01)), (ATTACKS, attacked), (LOOPS, (1.0,))):
        for share in shares:
            late = round(100 * share)
            turns.delays.append((kind, [0.2] * late + [0.01] * (100 - late)))
    assert turns.judge() == said


@pytest.mark.slow
def test_five_minutes_of_everything(tmp_path: Path) -> None:
    """Four of them by the clock: with and without attacks, and both beside busy loops."""
    options = {"minutes": "5", "realtime": "4", "source": "sim:loop?size=424x400&frames=300"}
    given = [f"--{name}={value}" for name, value in options.items()]
    assert main([*given, "--attacks", f"--work={tmp_path}"]) == 0
