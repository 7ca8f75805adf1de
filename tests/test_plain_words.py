"""Messages, help, pages and reports use the field's words: none of `docs/private_terms.toml` is in a text."""

from __future__ import annotations

import ast
import io
import re
import tokenize
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TERMS: dict[str, str] = tomllib.loads((ROOT / "docs" / "private_terms.toml").read_text())["terms"]
PRIVATE = re.compile(rf"(?<![\w./_-])(?:{'|'.join(TERMS)})(?![\w./_(]\w|[_(-])", re.IGNORECASE)
CODE = ("stereo_sfm", "drivers", "calib", "benchmarks", "examples", "recordings")
QUOTES = "benchmarks/_ablate_rules.py"  # lines of the core's source, to replace them
LINKS = (("stereo_sfm", "drivers"), ("stereo_sfm", "calib"))
PAGES = ("*.md", "docs/**/*.md", "changelog.d/*.md", "packaging/**/*.md", "stereo_sfm/**/static/*.html")


def programs() -> Iterator[Path]:
    for room in CODE:
        for path in sorted((ROOT / room).rglob("*.py")):
            name = path.relative_to(ROOT)
            if name.parts[:2] not in LINKS and name.as_posix() != QUOTES:
                yield path


def texts(program: str) -> Iterator[tuple[int, str]]:
    """Line and text of every string of more than one word, docstrings included, and of every comment."""
    for node in ast.walk(ast.parse(program)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value.strip():
            yield node.lineno, node.value
    for token in tokenize.generate_tokens(io.StringIO(program).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def found_in(lines: Iterator[tuple[int, str]]) -> list[str]:
    return [f"line {at}: {match[0]!r}" for at, text in lines for match in PRIVATE.finditer(text)]


def test_programs_use_the_fields_words() -> None:
    found: list[str] = []
    for path in programs():
        name = path.relative_to(ROOT).as_posix()
        found += [f"{name} {one}" for one in found_in(texts(path.read_text()))]
    assert not found, "\n".join(["say it in the words of docs/private_terms.toml:", *found])


@pytest.mark.parametrize("pattern", PAGES)
def test_pages_use_the_fields_words(pattern: str) -> None:
    found: list[str] = []
    for path in sorted(ROOT.glob(pattern)):
        found += [
            f"{path.relative_to(ROOT)} {one}" for one in found_in(iter(enumerate(path.read_text().splitlines(), 1)))
        ]
    assert not found, "\n".join(["say it in the words of docs/private_terms.toml:", *found])


def test_a_private_word_is_found() -> None:
    """In a message or a comment, not in a name."""
    program = '"""A knock of the rig."""\nlog.info("a knock at %s", 1)\nx = {"knock": knock.wanted()}  # one eye\n'
    assert found_in(texts(program)) == ["line 1: 'knock'", "line 2: 'knock'", "line 3: 'eye'"]
    assert not found_in(iter([(1, "the fisheye of /calibration/knock, camchain.yaml, tracker.knock")]))
