"""The harness that tells what rules and constants are worth: its edits fit the source, and change one thing each."""

from __future__ import annotations

import ast
import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def ablate(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setattr(sys, "path", [str(ROOT / "benchmarks"), *sys.path])
    return importlib.import_module("ablate")


def test_the_text_of_each_rule_is_in_the_source_once(ablate: ModuleType) -> None:
    """A change of the core must take the switch of a rule along, or remove it with the rule."""
    names = [rule.name for rule in ablate.RULES]
    assert len(names) == len(set(names)) > 50
    for rule in ablate.RULES:
        for file, old, new in rule.edits:
            source = (ROOT / "stereo_sfm" / file).read_text("utf-8")
            assert source.count(old) == 1, f"{rule.name}: {file}"
            ast.parse(source.replace(old, new))


def test_every_named_number_of_the_core_is_scaled_alone(ablate: ModuleType) -> None:
    source = "A = 2.0  # px\nB, C = 3, (0.5, 4)\nNAME = 'x'\ndef f():\n    return A\n"
    found = {name: new for name, _, _, new in ablate.scaled(source, 0.5)}
    assert found == {"A": "A = 1.0", "B": "B, C = (2, (0.5, 4))", "C": "B, C = (3, (0.25, 2))"}
    assert {v.name for v in ablate.constants([""], 2.0)} >= {"tracking/flow/consensus.py:SURE_S x 2"}


def test_constants_of_compiled_functions_are_known(ablate: ModuleType) -> None:
    source = "A = 1.0\nB = 2.0\n@njit\ndef f(x):\n    return A * x\ndef g(x):\n    return B * x\n"
    assert "A" in ablate.names_in_kernels(source) and "B" not in ablate.names_in_kernels(source)
