"""Each number that has a name in these rooms says what it is: a unit, and where it comes from."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "stereo_sfm"
ROOMS = ("calibration", "loop", "mapping", "maps", "papers", "tracking")
FILES = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]


def unexplained(source: str) -> list[str]:
    """Names of numbers at module level without a comment, beside them or on the lines before a group of them."""
    lines, found = source.splitlines(), list[str]()
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign):
            continue
        names = [n.id for t in node.targets for n in ast.walk(t) if isinstance(n, ast.Name) and n.id.isupper()]
        number = any(isinstance(n, ast.Constant) and type(n.value) in (int, float) for n in ast.walk(node.value))
        above = node.lineno - 2
        while above >= 0 and lines[above][:1].isupper() and "#" not in lines[above]:
            above -= 1
        beside = any("#" in line for line in lines[node.lineno - 1 : node.end_lineno])
        if names and number and not beside and not lines[above].startswith("#"):
            found += names
    return found


def test_an_unexplained_number_is_found() -> None:
    assert unexplained("A = 1.0\n\n# Metres, of a door.\nB = 2.0\nC, D = 3, 4  # of what\nE = 5\n") == ["A", "E"]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_numbers_are_explained(path: Path) -> None:
    assert unexplained(path.read_text("utf-8")) == []
