"""The README says what is so: its commands exist with their options, its Python runs, its test command is CI's."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

import stereo_sfm
from stereo_sfm.cli import COMMANDS, main

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text()


def help_of(command: str) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main([command, "--help"])
    return out.getvalue()


def test_commands_exist_with_their_options() -> None:
    calls = re.findall(r"stereo-sfm ([a-z][a-z0-9-]*)([^\n`]*)", TEXT)
    assert {"run", "eval", "record", "config"} <= {name for name, _ in calls}
    for name, rest in calls:
        assert name in COMMANDS, f"README calls 'stereo-sfm {name}'"
        text = help_of(name)
        for option in re.findall(r"(?<!\w)--[a-z][a-z-]+", rest):
            assert option in text, f"README gives '{name}' the option {option}"


def test_the_second_command_is_what_ci_runs() -> None:
    line = (ROOT / ".ci" / "run").read_text().strip().splitlines()[-1]
    assert f"    {line}\n" in TEXT


def test_nothing_local() -> None:
    assert not re.search(r"/work/|/home/|/root/|localhost|https?://[0-9]", TEXT)


def test_python_of_the_readme(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, data_root: Path) -> None:
    """With a short part of a real sequence in the place of the bundled recording."""
    code = re.search(r"```python\n(.*?)```", TEXT, re.S)
    assert code is not None
    monkeypatch.chdir(tmp_path)
    run_args = ["run", "--inline", str(data_root / "euroc_mh01"), "--max-frames", "4", "-o", "runs/one", "-q"]
    assert main(run_args) == 0
    monkeypatch.setattr(stereo_sfm, "demo_recording", lambda: data_root / "tum_vi_room1", raising=False)
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(code[1], "README.md", "exec"), {})
    lines = out.getvalue().splitlines()
    assert lines[0].startswith("tum_vi:") and "OK" in lines[1]
    assert lines[-1].endswith("(4, 4, 4)")
