"""Pages are short and plain; results come from their figures."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.test_docs import part_of_docs

ROOT = Path(__file__).parents[1]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
READ = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *DOCS]
NOTEBOOK = ("notebook.md", "notebook-ablation.md")
MOST_WORDS = 12_700  # of docs/ without the lab notebook
LONGEST = 25  # words of a sentence


def sentences(page: str) -> Iterator[str]:
    """Of the prose of a page: neither code, nor tables, nor titles."""
    text = re.sub(r"<!--.*?-->", "", re.sub(r"```.*?```", "\n\n", page, flags=re.S))
    for block in re.split(r"\n\s*\n", text):
        lines = [line for line in block.splitlines() if not line.startswith(("|", "#", "    ", ":::"))]
        paragraphs = " ".join(re.sub(r"^\s*(\*|-|\d+\.) ", "\n", line) for line in lines).split("\n")
        for paragraph in paragraphs:
            plain = re.sub(r"`[^`]*`", "it", re.sub(r"\]\([^)]*\)", "]", paragraph))
            yield from re.split(r"(?<=[.!?:;])\s+", plain)


@pytest.mark.parametrize("page", READ, ids=lambda page: str(page.relative_to(ROOT)))
def test_sentences_are_short(page: Path) -> None:
    long = [one for one in sentences(page.read_text()) if len(one.split()) > LONGEST]
    assert not long, "\n".join(long)


def test_the_documentation_is_short() -> None:
    assert sum(words(page) for page in DOCS if page.name not in NOTEBOOK) <= MOST_WORDS
    assert words(ROOT / "README.md") <= 500


def words(page: Path) -> int:
    """The bars of tables are none."""
    return sum(re.search(r"\w", word) is not None for word in page.read_text().split())


def test_the_readme_states_the_figures_of_the_benchmark() -> None:
    """Our row: both parts, with their standard deviations."""
    figures = json.loads((ROOT / "benchmarks" / "figures" / "spread.json").read_text())["figures"]
    row = re.search(r"\| \*\*stereo-sfm\*\* \|.*", (ROOT / "README.md").read_text())
    assert row is not None
    for sequence in ("KITTI 00", "EuRoC MH01"):
        se3, sim3 = (
            next(f for f in figures if f["sequence"].startswith(sequence) and f["quantity"] == f"map, ATE {align}")
            for align in ("SE(3)", "Sim(3)")
        )
        assert f"| {se3['value']} ± {se3['spread']} {se3['unit']} ({sim3['value']} {sim3['unit']}) |" in row[0]


def test_the_site_shows_the_lines_of_the_next_version() -> None:
    """Until a release moves them into the changelog."""
    lines = [path.read_text().strip() for path in (ROOT / "changelog.d").glob("*.*.md")]
    page = part_of_docs("hooks").text_of("changelog")
    assert page.startswith("# Changelog\n") and all(f"\n- {line}\n" in page for line in lines)
    assert not lines or page.index("## Next version") < page.index("## 0.1.0")


def test_every_picture_is_made_by_the_script() -> None:
    text = (ROOT / "docs" / "pictures.py").read_text()
    shown = {name for page in READ for name in re.findall(r"!\[[^]]*\]\((?:\.\./|docs/)?([\w.]+)\)", page.read_text())}
    assert shown and all(f'"{name}": ' in text for name in shown), shown
    assert shown == {path.name for path in (ROOT / "docs").glob("*.png")}


def test_the_page_of_results_is_made_from_its_figures() -> None:
    made = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / "results.py", "--check"], capture_output=True, text=True
    )
    assert made.returncode == 0, made.stdout + made.stderr


def test_a_benchmark_writes_its_figures(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import _figures  # pyright: ignore[reportMissingImports]

    figure = _figures.Figure("KITTI", "ATE", 0.3061, "m", 0.0254, 9)
    path = _figures.write("spread", "Accuracy", [figure], tmp_path)
    section = _figures.table(path)
    assert "| KITTI | 0.3061 ± 0.0254 m |" in section
    assert "9 runs each" in section[-2] and "numpy" in section[-2] and _figures.commit() in section[-2]
