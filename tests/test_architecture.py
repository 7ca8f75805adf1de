"""Allowed imports, and what is forbidden in the core; from the source files, not from loaded modules."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("stereo_sfm", "drivers", "calib")
LINKED = ("drivers", "calib")  # folders of their own that are rooms of the package by links

# The rooms, the ground floor first: each may import from rooms above it in this list, never from those below.
ROOMS: tuple[str, ...] = (
    "stereo_sfm.same_code",
    "stereo_sfm.errors",
    "stereo_sfm.folder_lock",
    "stereo_sfm.input_file",
    "stereo_sfm.storage",
    "stereo_sfm.kernel_cache",
    "stereo_sfm.timing",
    "stereo_sfm.messages",
    "stereo_sfm.types",
    "stereo_sfm.pixels",
    "stereo_sfm.arrays",
    "stereo_sfm.geometry",
    "stereo_sfm.calib",
    "stereo_sfm.settings",
    "stereo_sfm.config",
    "stereo_sfm.presets",
    "stereo_sfm.tracking",
    "stereo_sfm.papers",
    "stereo_sfm.calibration",
    "stereo_sfm.mapping",
    "stereo_sfm.loop",
    "stereo_sfm.log",  # a file format as well, which one of the drivers reads
    "stereo_sfm.drivers",
    "stereo_sfm.maps",
    "stereo_sfm.recording",
    "stereo_sfm.export",
    "stereo_sfm.viz",
    "stereo_sfm.dense",
    "stereo_sfm.pipeline",
    "stereo_sfm.jobs",
    "stereo_sfm.eval",
    "stereo_sfm.fleet",
    "stereo_sfm.system",
    "stereo_sfm.demo",
    "stereo_sfm.service",
    "stereo_sfm.commands",
    "stereo_sfm.cli",
    "stereo_sfm.__main__",
)
CORE = (
    "stereo_sfm.geometry",
    "stereo_sfm.tracking",
    "stereo_sfm.papers",
    "stereo_sfm.calibration",
    "stereo_sfm.mapping",
    "stereo_sfm.loop",
)
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
HEAVY = {"cv2", "numba", "scipy", "gtsam", "rerun", "mcap", "matplotlib", "numpy", "depthai", "usb", "ray", "obstore"}


def module_name(path: Path, root: Path = ROOT) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    parts = ("stereo_sfm", *parts) if parts[0] in LINKED else parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def files(*packages: str) -> list[Path]:
    return [p for name in packages for p in _files(ROOT / name.replace(".", "/"))]


def _files(folder: Path) -> list[Path]:
    """Without those that are here by a link."""
    found = sorted(folder.rglob("*.py"))
    return [p for p in found if not any(parent.is_symlink() for parent in p.parents)]


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


def room(name: str) -> str | None:
    """The room that holds a module; None for other packages and for the package's face, `stereo_sfm` itself."""
    return next((r for r in ROOMS if f"{name}.".startswith(f"{r}.")), None)


def room_imports(root: Path = ROOT) -> dict[tuple[str, str], str]:
    """(importing room, imported room) -> one import that ties them, those inside functions too."""
    ties: dict[tuple[str, str], str] = {}
    for path in (p for name in PACKAGES for p in _files(root / name)):
        importer = module_name(path, root)
        for name in imports(path):
            a, b = room(importer), room(name)
            if a and b and a != b:
                ties.setdefault((a, b), f"{path.relative_to(root)} imports {name}")
    return ties


def upward(ties: dict[tuple[str, str], str]) -> list[str]:
    """The imports that go up: without them no circle of rooms is possible."""
    return [why for (a, b), why in sorted(ties.items()) if ROOMS.index(a) < ROOMS.index(b)]


def test_every_module_is_in_a_room() -> None:
    homeless = {module_name(p) for p in files(*PACKAGES)} - {"stereo_sfm"}
    assert not {name for name in homeless if room(name) is None}


def test_no_room_imports_from_above_so_there_is_no_circle() -> None:
    assert not upward(room_imports())


def test_an_added_circle_is_found(tmp_path: Path) -> None:
    for place, text in (("mapping", "from stereo_sfm.types import F64"), ("loop", "import stereo_sfm.mapping.map")):
        folder = tmp_path / "stereo_sfm" / place
        folder.mkdir(parents=True)
        (folder / "a.py").write_text(text + "\n")
    assert not upward(room_imports(tmp_path))
    (tmp_path / "stereo_sfm" / "mapping" / "b.py").write_text("def f():\n    from stereo_sfm.loop.a import x\n")
    assert upward(room_imports(tmp_path)) == ["stereo_sfm/mapping/b.py imports stereo_sfm.loop.a.x"]


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
    assert room("stereo_sfm.pipeline.run.run") == "stereo_sfm.pipeline" and room("numpy.linalg") is None


def test_an_argparse_namespace_ends_at_a_commands_entry() -> None:
    """`run(args)` and the parsers of shared options take one; all other functions take typed options."""
    for path in sorted((ROOT / "stereo_sfm").rglob("*.py")):
        if path.name == "_options.py":
            continue
        functions = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.FunctionDef)]
        taking = [f.name for f in functions if any("Namespace" in ast.unparse(a.annotation or a) for a in f.args.args)]
        allowed = {"run"} if path.parent.name == "commands" else {"_start_logging"}
        assert set(taking) <= allowed, f"{path.name}: {', '.join(taking)}"


def test_test_files_have_names_of_their_own() -> None:
    """They are imported by name: of two that share one the second is never run."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []
