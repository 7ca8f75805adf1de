"""Kernels without a Python wrapper (`inner`, `inlined`) are named in kernels only: Python would crash with them."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
INNER = {"inner", "inlined"}
KERNELS = {"njit", *INNER}


def _decorators(node: ast.AST) -> set[str]:
    return {d.id for d in getattr(node, "decorator_list", []) if isinstance(d, ast.Name)}


def _module(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def _used_in_python(tree: ast.Module) -> set[str]:
    """Names and `module.name` outside of kernels."""
    used, waiting = set[str](), list[ast.AST](tree.body)
    while waiting:
        node = waiting.pop()
        if _decorators(node) & KERNELS:
            continue
        if isinstance(node, ast.Name):
            used.add(node.id)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            used.add(f"{node.value.id}.{node.attr}")
        waiting.extend(ast.iter_child_nodes(node))
    return used


def _known_as(tree: ast.Module, inner: set[str]) -> dict[str, str]:
    """What inner kernels `module.name` are called in a file that imports them."""
    known = dict[str, str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            for name in node.names:
                whole, called = f"{node.module}.{name.name}", name.asname or name.name
                known |= {called: whole} if whole in inner else {}
                known |= {f"{called}.{i.rpartition('.')[2]}": i for i in inner if i.rpartition(".")[0] == whole}
    return known


def test_python_names_no_inner_kernel() -> None:
    paths = [p for folder in ("stereo_sfm", "tests", "benchmarks", "examples") for p in (ROOT / folder).rglob("*.py")]
    trees = {_module(p): ast.parse(p.read_text()) for p in paths}
    defined = {(m, n.name) for m, tree in trees.items() for n in tree.body if INNER & _decorators(n)}  # type: ignore[attr-defined]
    inner = {f"{module}.{name}" for module, name in defined}
    assert len(inner) > 20
    wrong = [
        f"{module}: {whole}"
        for module, tree in trees.items()
        for called, whole in (_known_as(tree, inner) | {n: f"{m}.{n}" for m, n in defined if m == module}).items()
        if called in _used_in_python(tree)
    ]
    assert not wrong
