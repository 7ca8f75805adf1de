"""Every program of `examples/` runs, on a short part of the bundled recording."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
SAID = {
    "export.py": "written: colmap, points.ply, trajectory.tum",
    "odometry_only.py": "OK: [",
    "own_loop.py": "keyframes\npath of 0.",
    "where_is_this.py": "mm from its pose",
}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_an_example_runs_and_prints_its_output(
    path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    runpy.run_path(str(path))["main"](12)
    assert SAID[path.name] in capsys.readouterr().out
