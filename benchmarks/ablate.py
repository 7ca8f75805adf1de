"""What each rule and each constant of the core is worth: every one off, doubled or halved, one at a time.

    STEREO_SFM_REAL=FOLDER STEREO_SFM_DATA=FOLDER python benchmarks/ablate.py rules
    python benchmarks/ablate.py constants --only tracking/flow --factor 2 0.5
    python benchmarks/ablate.py rules --all              on all parts, not only those of the screen
    python benchmarks/ablate.py rules --table            only the table of what is stored

A rule is switched off by an edit of the source (`_ablate_rules.py`), in a copy of the package of its own: no switch is
left in the product. A constant is a number in a named constant of a module of the core. The screen is three short parts
of real sequences. The table has frames lost and errors of map and odometry for each variant and part, and = where the
result has the same bits as the product's: there the rule did nothing. What matters is run with `--all`.

Results are stored under STORE by the code of the package, the variant and the part: an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _ablate_rules import RULES
from _real_sequences import SEQUENCES, real_root
from _sequences import ROOT

CORE = ("tracking", "papers", "calibration", "mapping", "loop", "maps")
PACKAGES = ("stereo_sfm", "drivers", "calib")
RUNNER = Path(__file__).with_name("_ablate_run.py")
LONGEST_S = 1800.0


@dataclass(frozen=True)
class Part:
    """Some seconds of a sequence of `_real_sequences`."""

    sequence: str
    start_s: float = 0.0
    duration_s: float = 0.0  # 0: to the end
    screen: bool = False

    @property
    def name(self) -> str:
        """As in the table."""
        return f"{self.sequence} {self.start_s:g} s"


PARTS = (
    Part("karlsruhe_0019", 3.0, 4.0, screen=True),
    Part("bonn_crowd", 9.0, 4.0, screen=True),
    Part("library_walk", screen=True),
    Part("karlsruhe_0019", 20.0, 15.0),
    Part("kitti_extract", 0.0, 15.0),
    Part("kitti_06"),
    Part("fr1_xyz", 0.0, 8.0),
    Part("euroc_mh01_part"),
    Part("store_walk", 0.0, 20.0),
    *(Part("bonn_crowd", start, 5.0) for start in (0.0, 2.0, 7.0, 12.0, 15.5, 18.0, 20.0, 22.0)),
)


@dataclass(frozen=True)
class Variant:
    """An edit of the package: files and their texts."""

    name: str
    edits: tuple[tuple[str, str, str], ...]  # file below stereo_sfm, old text, new text
    compiled: bool = False  # whether kernels are to be compiled again, which takes minutes


def rules() -> list[Variant]:
    """Every rule off."""
    return [Variant(rule.name, rule.edits) for rule in RULES]


def constants(only: list[str], factor: float) -> Iterator[Variant]:
    """Every named number of the core's modules times a factor."""
    files = [p for room in CORE for p in sorted((ROOT / "stereo_sfm" / room).rglob("*.py"))]
    in_kernels = set[str]().union(*(names_in_kernels(p.read_text("utf-8")) for p in files))
    for path in files:
        file = path.relative_to(ROOT / "stereo_sfm").as_posix()
        source = path.read_text("utf-8")
        for name, line, old, new in scaled(source, factor):
            if any(text in f"{file}:{name}" for text in only):
                edit = (file, *_unique(source, line, old, new))
                yield Variant(f"{file}:{name} x {factor:g}", (edit,), name in in_kernels)


def names_in_kernels(source: str) -> set[str]:
    """Names that compiled functions use."""
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef) and n.decorator_list]
    compiled = [f for f in functions if {"njit", "inner", "inlined"} & {ast.unparse(d) for d in f.decorator_list}]
    return {n.id for f in compiled for n in ast.walk(f) if isinstance(n, ast.Name)}


def scaled(source: str, factor: float) -> Iterator[tuple[str, int, str, str]]:
    """Of each named constant that is a number or several: name, line, text of its statement, the same times a factor.

    Whole numbers stay whole, and at least 1.
    """
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        names = [t.id for t in (target.elts if isinstance(target, ast.Tuple) else [target]) if isinstance(t, ast.Name)]
        if not names or not all(n.isupper() for n in names):
            continue
        values = (
            node.value.elts if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple) else [node.value]
        )
        if len(values) != len(names):
            continue
        old = ast.get_source_segment(source, node) or ""
        for k, name in enumerate(names):
            if not any(isinstance(n, ast.Constant) and type(n.value) in (int, float) for n in ast.walk(values[k])):
                continue
            changed = ast.parse(old).body[0]
            assert isinstance(changed, ast.Assign | ast.AnnAssign) and changed.value is not None
            elements = (
                changed.value.elts if len(values) > 1 and isinstance(changed.value, ast.Tuple) else [changed.value]
            )
            for n in ast.walk(elements[k]):
                if isinstance(n, ast.Constant) and isinstance(n.value, int | float) and not isinstance(n.value, bool):
                    n.value = max(round(n.value * factor), 1) if isinstance(n.value, int) else n.value * factor
            yield name, node.lineno, old, ast.unparse(changed)


def _unique(source: str, line: int, old: str, new: str) -> tuple[str, str]:
    """Old and new text with what is before it in the file, so that it occurs once."""
    head = "".join(source.splitlines(keepends=True)[: line - 1])
    return head + old, head + new


def copy_of_package(folder: Path, variant: Variant) -> None:
    """The package with the variant's edits, sharing all other files and compiled kernels with this checkout."""
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, copy_function=os.link)
    shutil.copytree(ROOT / "recordings", folder / "recordings", copy_function=os.link)
    for file, old, new in variant.edits:
        path = folder / "stereo_sfm" / file
        text = path.read_text("utf-8")
        if text.count(old) != 1:
            raise SystemExit(f"{variant.name}: {file} has its text {text.count(old)} times")
        path.unlink()
        path.write_text(text.replace(old, new), "utf-8")
    if variant.compiled:  # a kernel does not know of a constant in one that it calls
        for path in folder.rglob("*.nb[ic]"):
            path.unlink()


def run(variant: Variant, parts: list[Part], store: Path) -> dict[str, dict[str, Any]]:
    """The stored results of a variant by part; what is missing is run."""
    path = store / f"{variant.name.replace('/', '.').replace(' ', '_')}.json"
    found: dict[str, dict[str, Any]] = json.loads(path.read_text("utf-8")) if path.is_file() else {}
    missing = [part for part in parts if part.name not in found and place(part) is not None]
    if not missing:
        return found
    with tempfile.TemporaryDirectory(prefix="stereo_sfm_ablate_", dir=ROOT.parent) as scratch:
        copy_of_package(Path(scratch), variant)
        args = [x for part in missing for x in (*_arguments(part), "--")]
        command = [sys.executable, str(RUNNER), *args]
        environment = {**os.environ, "PYTHONPATH": scratch}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=LONGEST_S, cwd=scratch)
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    found |= {part.name: line for part, line in zip(missing, lines, strict=False)}
    if done.returncode < 0 or done.returncode == 130:
        raise SystemExit(f"{variant.name}: stopped ({done.returncode})")
    for part in missing[len(lines) :]:
        found[part.name] = {"error": (done.stderr.strip().splitlines() or ["no result"])[-1]}
    store.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(found, indent=1), "utf-8")
    return found


def place(part: Part) -> tuple[Path, str] | None:
    """Where a part's sequence lies, and its rig; None if it is not at hand."""
    sequence = next(s for s in SEQUENCES if s.name == part.sequence)
    path = sequence.path(real_root(None))
    return None if path is None else (path, str(path.parent / sequence.rig) if sequence.rig else "")


def _arguments(part: Part) -> list[str]:
    found = place(part)
    assert found is not None
    path, rig = found
    return [str(path), f"{part.start_s}", f"{part.duration_s}", *([rig] if rig else [])]


def code_key() -> str:
    """Of the package's contents in git, and of what is not committed."""
    tree = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", *(f"HEAD:{p}" for p in PACKAGES)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    differences = ["git", "-C", str(ROOT), "diff", "HEAD", "--", *PACKAGES]
    changed = subprocess.run(differences, capture_output=True, check=True).stdout
    return hashlib.sha256("".join(tree).encode() + changed).hexdigest()[:12]


def table(results: dict[str, dict[str, dict[str, Any]]], parts: list[Part]) -> str:
    """Each variant against the product: frames lost and errors; = where the bits are the same."""
    rows = [f"| variant | {' | '.join(p.name for p in parts)} |", "|---" * (len(parts) + 1) + "|"]
    product = results["product"]
    for name, found in results.items():
        cells = [_cell(found.get(p.name), product.get(p.name), name == "product") for p in parts]
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _cell(found: dict[str, Any] | None, product: dict[str, Any] | None, is_product: bool) -> str:
    if found is None or product is None:
        return ""
    if "error" in found:
        return found["error"][:40]
    if not is_product and found["bits"] == product.get("bits"):
        return "="
    error = f"{found['map_m']:.4f} ({found['odometry_m'] or 0:.4f})" if found.get("map_m") is not None else "–"
    lost = f", {found['lost']} lost" if found["lost"] else ""
    return error + lost + (f", {found['steps']} steps" if found["steps"] else "")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("rules", "constants"))
    parser.add_argument("--only", default=[""], nargs="+", help="variants whose name contains one of these")
    parser.add_argument("--factor", type=float, nargs="+", default=[2.0])
    parser.add_argument("--kernels", action="store_true", help="also constants of compiled functions")
    parser.add_argument("--part", default="", help="parts whose name contains this, screen or not")
    parser.add_argument("--all", action="store_true", help="all parts, not only those of the screen")
    parser.add_argument("--table", action="store_true", help="run nothing")
    parser.add_argument("--store", type=Path, default=ROOT / ".benchmarks" / "ablate")
    args = parser.parse_args()
    store, parts = (
        args.store / code_key(),
        [p for p in PARTS if (args.part in p.name if args.part else args.all or p.screen)],
    )
    variants = (
        [v for v in rules() if any(text in v.name for text in args.only)]
        if args.what == "rules"
        else [v for factor in args.factor for v in constants(args.only, factor)]
    )
    variants = [v for v in variants if args.kernels or not v.compiled]
    results: dict[str, dict[str, dict[str, Any]]] = {}
    for k, variant in enumerate([Variant("product", ()), *variants]):
        if args.table:
            path = store / f"{variant.name.replace('/', '.').replace(' ', '_')}.json"
            if path.is_file():
                results[variant.name] = json.loads(path.read_text("utf-8"))
        else:
            results[variant.name] = run(variant, parts, store)
            cells = [_cell(results[variant.name].get(p.name), results["product"].get(p.name), k == 0) for p in parts]
            print(f"{k}/{len(variants)} {variant.name}: {'; '.join(cells)}", file=sys.stderr, flush=True)
    if results:
        print(table(results, parts))
    return 0


if __name__ == "__main__":
    sys.exit(main())
