"""README and docs are correct: their commands exist with their options, their Python runs, CI calls the tests."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

import stereo_sfm
from stereo_sfm.cli import COMMANDS, main

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def help_of(command: str) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main([command, "--help"])
    return out.getvalue()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_exist_with_their_options(page: Path) -> None:
    for name, rest in re.findall(r"stereo-sfm ([a-z][a-z0-9-]*)([^\n`|]*)", page.read_text()):
        assert name in COMMANDS, f"{page.name} calls 'stereo-sfm {name}'"
        text = help_of(name)
        for option in re.findall(r"(?<!\w)--[a-z][a-z-]+", rest):
            assert option in text, f"{page.name} gives '{name}' the option {option}"


def test_every_command_is_named_somewhere() -> None:
    text = "".join(page.read_text() for page in PAGES)
    assert not {name for name in COMMANDS if f"stereo-sfm {name}" not in text}


def test_ci_runs_the_second_command() -> None:
    line = (ROOT / ".ci" / "run").read_text().strip().splitlines()[-1]
    assert f"    {line}\n" in (ROOT / "README.md").read_text()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_no_local_paths(page: Path) -> None:
    assert not re.search(r"/work/|/home/|/root/|localhost|https?://[0-9]", page.read_text())


def test_links_between_pages_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text()):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.relative_to(ROOT)} links to {target}"


def test_the_example_calibration_can_be_read() -> None:
    rig = stereo_sfm.load_rig(ROOT / "docs" / "example_rig.yaml")
    assert rig.baseline == pytest.approx(0.11)


def test_python_of_the_docs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, data_root: Path) -> None:
    """With a short real sequence in the place of the bundled recording."""
    code = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "tasks" / "python.md").read_text(), re.S)
    assert code is not None
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(stereo_sfm, "demo_recording", lambda: data_root / "tum_vi_room1", raising=False)
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(code[1], "python.md", "exec"), {})
    lines = out.getvalue().splitlines()
    assert len(lines) == 4 and all(" OK " in line for line in lines)
