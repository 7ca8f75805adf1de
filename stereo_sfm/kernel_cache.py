"""Where compiled kernels are kept between runs, and notifications while they are compiled.

numba keeps them beside the source files. Where those may not be written to (an installation of another user, a
read-only file system) they go to the user's cache, else to a folder of temporary files, and what was compiled at the
installation (`stereo-sfm compile`) is taken along.
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")  # of errors while types are tried: 2 % of time

import numba
from numba.core import config, event
from numba.core.caching import UserProvidedCacheLocator

VARIABLE = "NUMBA_CACHE_DIR"
ROOT = Path(__file__).parents[1]
PACKAGES = ("stereo_sfm", "drivers", "calib")
COMPILING = "numba:compile"


def usable(folder: Path) -> bool:
    """Whether files can be created in a folder, which is created if needed."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def private(folder: Path) -> bool:
    """Whether only this user can write to a folder: its content is executed."""
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022 and usable(folder)


def choose_folder(root: Path = ROOT) -> Path | None:
    """A folder for compiled kernels where neither the user's choice nor the source tree will do, else None."""
    chosen = os.environ.get(VARIABLE)
    if (chosen and usable(Path(chosen))) or usable(root / "stereo_sfm" / "geometry" / "__pycache__"):
        return None
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "stereo-sfm"
    if usable(cache):
        return cache
    shared = Path(tempfile.gettempdir()) / f"stereo-sfm-{os.getuid()}"
    return shared if private(shared) else Path(tempfile.mkdtemp(prefix="stereo-sfm-"))


def copy_compiled(root: Path, folder: Path) -> None:
    """Copy what was compiled beside the source files to where numba looks for it in another folder."""
    for source in (p for package in PACKAGES for p in sorted((root / package).rglob("__pycache__"))):
        target = folder / UserProvidedCacheLocator.get_suitable_cache_subpath(str(source.parent / "module.py"))
        for path in (p for p in sorted(source.glob("*.nb[ic]")) if not (target / p.name).exists()):
            target.mkdir(parents=True, exist_ok=True)
            part = target / f"{path.name}.{os.getpid()}"
            shutil.copyfile(path, part)
            part.replace(target / path.name)


def _prepare() -> bool:
    """Whether there is a place to keep kernels in; other processes of the run find the same one."""
    try:
        folder = choose_folder()
        if folder is not None:
            copy_compiled(ROOT, folder)
            config.CACHE_DIR = os.environ[VARIABLE] = str(folder)  # pyright: ignore[reportAttributeAccessIssue]
    except OSError:
        return False
    return True


_KEPT = _prepare()


def jit(**options: Any) -> Any:
    """`numba.njit` with the options, its results kept where there is a place for them.

    Nothing calls kernels by the address that C would need: making it would take 4 % of the compilation.
    """
    options |= {"cache": _KEPT, "no_cfunc_wrapper": True}
    return numba.njit(**options)


def compiled(kernel: Any) -> bool:
    """Whether an earlier process has kept the code of a kernel."""
    name = kernel.py_func.__qualname__
    return any(Path(kernel.stats.cache_path).glob(f"{Path(kernel.py_func.__code__.co_filename).stem}.{name}-*.nbi"))


class Compilation(event.Listener):
    """Counts the kernels compiled while it listens, and the seconds this takes."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self.kernels, self.seconds = 0, 0.0
        self._report, self._since, self._depth = report, 0.0, 0

    def on_start(self, event: Any) -> None:
        """Compilation of a kernel begins, possibly within that of its caller."""
        if not self._depth:
            self._since = time.perf_counter()
        self._depth += 1
        self.kernels += 1
        self._report(event.data["dispatcher"].py_func.__name__.strip("_"))

    def on_end(self, event: Any) -> None:
        """Compilation of a kernel ends."""
        self._depth -= 1
        if not self._depth:
            self.seconds += time.perf_counter() - self._since


def count_compilation() -> Compilation:
    """A `Compilation` that listens as long as this process lives."""
    listener = Compilation(lambda _: None)
    event.register(COMPILING, listener)
    return listener


@contextmanager
def listening(report: Callable[[str], None]) -> Generator[Compilation]:
    """Report the name of every kernel compiled in the `with` block, not of those loaded from the cache."""
    listener = Compilation(report)
    event.register(COMPILING, listener)
    try:
        yield listener
    finally:
        event.unregister(COMPILING, listener)
