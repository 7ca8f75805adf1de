"""The first run on a machine reports compilation, which does not count in its frame rate."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stereo_sfm import kernel_cache
from stereo_sfm.commands._progress import CompilationProgress, LinesOnly, NoProgress
from stereo_sfm.messages import Compiling
from stereo_sfm.pipeline.processes import ProcessRun
from tests.pipeline.test_pipeline import CONFIG, MadeSource, SlidingWall


class Bar(NoProgress):
    def __init__(self) -> None:
        self.shown: list[str] = []

    def show(self, state: str) -> None:
        self.shown.append(state)


def test_the_bar_names_each_kernel(capsys: pytest.CaptureFixture[str]) -> None:
    shown, bar = CompilationProgress(), Bar()
    shown.bar = bar
    shown.put(Compiling("tracker", "match_rows"))
    shown.put("anything else")
    shown.put(Compiling("mapper", "reduce"))
    assert len(bar.shown) == 2
    assert bar.shown[1] == "first run here: compiling reduce (mapper), kernel 2"
    shown.bar = LinesOnly()  # no terminal: one line, not a hundred
    fresh = CompilationProgress()
    fresh.bar = LinesOnly()
    fresh.put(Compiling("tracker", "match_rows"))
    fresh.put(Compiling("tracker", "match_columns"))
    assert capsys.readouterr().err.count("first run on this machine") == 1


def test_the_time_until_every_stage_is_ready_is_measured() -> None:
    with ProcessRun(MadeSource.of(SlidingWall, 3), CONFIG) as run:
        begin = time.perf_counter()
        assert run.began_s is None
        assert len(list(run)) == 3
        assert run.began_s is not None and begin < run.began_s < time.perf_counter()


@pytest.mark.slow
def test_a_first_run_and_a_run_after_compile(tmp_path: Path) -> None:
    """`compile` fills an empty kernel folder with everything that a run needs."""
    environment = os.environ | {kernel_cache.VARIABLE: str(tmp_path / "kernels")}
    command = [sys.executable, "-m", "stereo_sfm.cli"]
    begin = time.monotonic()
    run = [*command, "run", "--max-frames", "8", "-o", str(tmp_path / "first")]
    first = subprocess.run(run, capture_output=True, text=True, env=environment)
    wall_s = time.monotonic() - begin
    assert first.returncode == 0, first.stderr
    assert "first run on this machine: compiling" in first.stderr
    assert json.loads((tmp_path / "first" / "stats.json").read_text())["wall_s"] < 0.5 * wall_s
    made = subprocess.run([*command, "compile"], capture_output=True, text=True, env=environment)
    assert made.returncode == 0 and "later runs start at once" in made.stdout
    again = subprocess.run([*run[:-1], str(tmp_path / "again")], capture_output=True, text=True, env=environment)
    assert "compiling" not in again.stderr
