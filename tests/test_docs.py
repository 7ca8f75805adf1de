"""README and docs are correct: their commands exist with their options, their Python runs, CI calls the tests."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import re
from pathlib import Path
from types import ModuleType

import griffe
import pytest

import stereo_sfm
from stereo_sfm.cli import COMMANDS, main

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def help_of(*words: str) -> str:
    """Of a command, or of an action of it."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main([*words, "--help"])
    return out.getvalue()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_exist_with_their_options(page: Path) -> None:
    for name, rest in re.findall(r"stereo-sfm ([a-z][a-z0-9-]*)([^\n`|]*)", page.read_text()):
        assert name in COMMANDS, f"{page.name} calls 'stereo-sfm {name}'"
        text = help_of(name)
        if "ACTION" in text and (action := re.match(r" ([a-z]+) ", rest)):
            text += help_of(name, action[1])
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


def test_each_row_of_the_inputs_is_a_test() -> None:
    page = (ROOT / "docs" / "reference" / "inputs.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("|") and "`test_" in line]
    known = "".join(p.read_text() for p in (ROOT / "tests").rglob("test_*.py"))
    assert len(rows) > 20
    for row in rows:
        for name in re.findall(r"`(test_\w+)`", row):
            assert f"def {name}(" in known, f"no test {name} for the row: {row}"


def test_links_between_pages_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text()):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.relative_to(ROOT)} links to {target}"


def test_the_example_calibration_can_be_read(tmp_path: Path) -> None:
    text = re.search(r"```yaml\n(.*?)```", (ROOT / "docs" / "tasks" / "own-data.md").read_text(), re.S)
    assert text is not None
    (tmp_path / "rig.yaml").write_text(text[1])
    assert stereo_sfm.load_rig(tmp_path / "rig.yaml").baseline == pytest.approx(0.11)


def part_of_docs(name: str) -> ModuleType:
    """A module of docs/, which is no package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_place_of_the_site_is_filled(monkeypatch: pytest.MonkeyPatch) -> None:
    """And a reader of the files sees neither marks nor includes, of which a formatter of code makes others."""
    monkeypatch.chdir(ROOT)
    hooks = part_of_docs("hooks")
    for page in PAGES:
        text = page.read_text()
        assert not re.search(r"\{\{|-\s*8\s*<", text), f"{page.name} shows an include"
        filled = hooks.on_page_markdown(text)
        assert "<!--" not in filled, f"{page.name} has a place that is not filled"
        for what, instead in hooks.PLACE.findall(text):
            assert what == "nothing" or hooks.text_of(what).strip() in filled
            assert instead.strip(), f"{page.name} shows nothing in the place of {what}"


PUBLIC = [name for name in stereo_sfm.__all__ if name != "__version__"]


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_is_in_the_reference(name: str) -> None:
    entries = (ROOT / "docs" / "reference" / "api.md").read_text().splitlines()
    assert f"::: stereo_sfm.{name}" in entries


def test_every_field_of_a_public_class_is_described() -> None:
    """By the comment beside it, which the reference shows."""
    extensions = griffe.load_extensions(part_of_docs("field_comments").FieldComments)
    package = griffe.load("stereo_sfm", extensions=extensions, search_paths=[str(ROOT)])
    docs: dict[str, str] = {}
    for name in PUBLIC:
        entry = package[name].final_target if package[name].is_alias else package[name]
        docs[name] = entry.docstring.value
    docs.pop("Config")  # its settings have a page
    assert not {(name, line) for name, text in docs.items() for line in re.findall(r"^    \w+ \(.*\):\s*$", text, re.M)}
    for field in (
        "covariance (F64): (6, 6) of the pose",
        'reason (str): "" where',
        "stats (dict[str, float]): numbers",
    ):
        assert field in docs["Frame"]
    assert "TOPIC" not in docs["Frame"]


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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_settings_exist(page: Path) -> None:
    sections = {
        section: vars(value) for section, value in vars(stereo_sfm.Config()).items() if hasattr(value, "__dict__")
    }
    for section, name in re.findall(rf"(?<![\w./])({'|'.join(sections)})\.([a-z]\w+)\b(?![./])", page.read_text()):
        assert name in sections[section] or name in ("py", "md"), f"{page.name} names the setting {section}.{name}"


def test_files_named_in_the_docs_exist() -> None:
    for page in PAGES:
        for name in re.findall(
            r"`((?:stereo_sfm|drivers|calib|tests|benchmarks|examples)/[\w./]*\w\.\w+)`", page.read_text()
        ):
            assert (ROOT / name).is_file(), f"{page.name} names {name}"
