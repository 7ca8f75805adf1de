"""Who may import whom, and what the core never does. Read from the source files, not from what happens to be loaded."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("stereo_sfm", "drivers", "calib")

# Each room may import from its own level and from lower ones.
LEVELS: tuple[tuple[str, ...], ...] = (
    (
        "stereo_sfm.errors",
        "stereo_sfm.types",
        "stereo_sfm.pixels",
        "stereo_sfm.timing",
        "stereo_sfm.config",
        "stereo_sfm.pipeline.sinks",
    ),
    ("stereo_sfm.geometry",),
    ("calib",),
    # The log is a file format as well, which one of the drivers reads.
    ("stereo_sfm.tracking", "stereo_sfm.mapping", "stereo_sfm.loop", "drivers", "stereo_sfm.log"),
    ("stereo_sfm.pipeline", "stereo_sfm.viz", "stereo_sfm.export", "stereo_sfm.eval"),
    ("stereo_sfm.commands", "stereo_sfm.cli"),
)
CORE = ("stereo_sfm.geometry", "stereo_sfm.tracking", "stereo_sfm.mapping", "stereo_sfm.loop")
SHELL_ONLY = {
    "time",
    "datetime",
    "multiprocessing",
    "threading",
    "subprocess",
    "socket",
    "rerun",
    "mcap",
    "rich",
    "logging",
}
LIGHT = ("stereo_sfm/cli.py", "stereo_sfm/__init__.py", "stereo_sfm/errors.py", "stereo_sfm/commands/*.py")
HEAVY = {"cv2", "numba", "scipy", "gtsam", "rerun", "mcap", "matplotlib", "numpy", "depthai", "usb", "ray"}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def files(*packages: str) -> list[Path]:
    return [p for name in packages for p in sorted((ROOT / name.replace(".", "/")).rglob("*.py"))]


def source_of(name: str) -> Path | None:
    """The file of the longest part of a dotted name that is a module of ours."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        base = ROOT.joinpath(*parts[:end])
        for path in (base.with_suffix(".py"), base / "__init__.py"):
            if parts[0] in PACKAGES and path.is_file():
                return path
    return None


def loaded_with(path: Path) -> set[str]:
    """Every name imported when a file is imported, our own modules followed."""
    names: set[str] = set()
    seen: set[Path] = set()
    pending = [path]
    while pending:
        current = pending.pop()
        if current in seen:
            continue
        seen.add(current)
        found = imports(current, everywhere=False)
        names.update(found)
        pending += [source for name in found if (source := source_of(name)) is not None]
    return names


def is_type_checking(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def imports(path: Path, everywhere: bool = True) -> list[str]:
    """Full names imported by a file; only those at its top level with everywhere=False. Not those for types alone."""
    tree = ast.parse(path.read_text(), str(path))
    found: list[str] = []
    pending: list[ast.stmt] = list(tree.body)
    while pending:
        node = pending.pop()
        if is_type_checking(node):
            continue
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found += [f"{node.module}.{alias.name}" for alias in node.names]
        elif everywhere or not isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            pending += [child for child in ast.walk(node) if isinstance(child, ast.stmt) and child is not node]
    return found


def level(name: str) -> int | None:
    """The level of the narrowest room that holds the module; None for what has no place (other packages, the root)."""
    rooms = [(len(room), i) for i, rooms in enumerate(LEVELS) for room in rooms if f"{name}.".startswith(f"{room}.")]
    return max(rooms)[1] if rooms else None


@pytest.mark.parametrize("path", files(*PACKAGES), ids=module_name)
def test_imports_go_down(path: Path) -> None:
    own = level(module_name(path))
    if own is None:
        return
    upward = [name for name in imports(path) if (other := level(name)) is not None and other > own]
    assert not upward, f"{module_name(path)} imports from above: {', '.join(sorted(set(upward)))}"


@pytest.mark.parametrize("path", files(*CORE), ids=module_name)
def test_core_has_no_clock_files_processes_or_prints(path: Path) -> None:
    roots = {name.split(".")[0] for name in imports(path)}
    assert not roots & SHELL_ONLY
    calls = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)]
    names = {c.func.id for c in calls if isinstance(c.func, ast.Name)}
    assert not names & {"print", "input"}
    chains = {ast.unparse(c.func) for c in calls if isinstance(c.func, ast.Attribute)}
    seeded = {"np.random.default_rng", "np.random.Generator", "np.random.SeedSequence", "np.random.PCG64"}
    assert not {c for c in chains if c.startswith("np.random.")} - seeded, "global random state"


@pytest.mark.parametrize("path", [p for pattern in LIGHT for p in sorted(ROOT.glob(pattern))], ids=module_name)
def test_command_line_imports_nothing_heavy_at_module_level(path: Path) -> None:
    heavy = {name for name in loaded_with(path) if name.split(".")[0] in HEAVY}
    assert not heavy, f"import inside the function: {', '.join(sorted(heavy))}"


def test_the_rules_can_fail(tmp_path: Path) -> None:
    bad = tmp_path / "bad.py"
    bad.write_text("def f():\n    from stereo_sfm.pipeline.run import run\n    import time\nif True:\n    import cv2\n")
    assert set(imports(bad)) == {"stereo_sfm.pipeline.run.run", "time", "cv2"}
    assert imports(bad, everywhere=False) == ["cv2"]
    assert "numpy" in loaded_with(ROOT / "stereo_sfm" / "eval" / "associate.py")
    assert level("stereo_sfm.pipeline.run.run") == 4 and level("numpy.linalg") is None
