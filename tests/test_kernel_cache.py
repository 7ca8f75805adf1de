"""Compiled kernels find a place wherever the home and the installation may not be written to."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm import kernel_cache
from stereo_sfm.kernel_cache import ROOT, choose_folder, copy_compiled, listening, private


@pytest.fixture
def read_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A place whose tree and home cannot hold files (tests may run as root, who may write anywhere)."""
    for name in ("tree", "home"):
        (tmp_path / name).write_text("a file where a folder should be made")
    monkeypatch.delenv(kernel_cache.VARIABLE, raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    return tmp_path


def test_a_tree_that_can_be_written_to_holds_its_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(kernel_cache.VARIABLE, raising=False)
    assert choose_folder(ROOT) is None


def test_without_tree_and_home_they_are_temporary_files_of_this_user(read_only: Path) -> None:
    folder = choose_folder(read_only / "tree")
    assert folder == read_only / "temporary" / f"stereo-sfm-{os.getuid()}"
    assert folder.stat().st_mode & 0o777 == 0o700
    assert choose_folder(read_only / "tree") == folder  # the next run finds what this one compiled


def test_a_folder_that_others_may_write_to_is_not_trusted(read_only: Path) -> None:
    folder = read_only / "temporary" / f"stereo-sfm-{os.getuid()}"
    folder.mkdir()
    folder.chmod(0o777)
    assert not private(folder)
    assert choose_folder(read_only / "tree") != folder
    (read_only / "link").symlink_to(read_only / "temporary")
    assert not private(read_only / "link")


def test_code_compiled_at_the_installation_is_reused(tmp_path: Path) -> None:
    cache = tmp_path / "stereo_sfm" / "geometry" / "__pycache__"
    cache.mkdir(parents=True)
    (cache / "kernels.f-1.py311.nbi").write_bytes(b"index")
    copy_compiled(tmp_path, tmp_path / "kept")
    copy_compiled(tmp_path, tmp_path / "kept")
    assert [p.read_bytes() for p in (tmp_path / "kept").rglob("*.nbi")] == [b"index"]


def test_whether_a_kernel_is_compiled_is_seen_in_its_folder() -> None:
    from stereo_sfm.geometry.hamming import hamming

    words = np.array([[0, 1, 2, 3]], np.uint64)
    hamming(words, 0, words, 0)
    assert kernel_cache.compiled(hamming)
    never = kernel_cache.jit()(lambda x: x + 1)
    assert not kernel_cache.compiled(never)


def test_compilations_are_reported() -> None:
    told: list[str] = []
    kernel = kernel_cache.numba.njit(lambda x: x + 1)
    with listening(told.append) as compilation:
        assert kernel(1) == 2
        assert kernel(2) == 3
    kernel(1.5)
    assert len(told) == compilation.kernels == 1
    assert compilation.seconds > 0


READ_ONLY = """
import tempfile
real = tempfile.TemporaryFile
def refuse(*args, dir=None, **kwargs):
    if dir is not None and not str(dir).startswith({temporary!r}):
        raise OSError(30, "Read-only file system")
    return real(*args, dir=dir, **kwargs)
tempfile.TemporaryFile = refuse
from stereo_sfm.geometry.hamming import hamming
import numpy as np
words = np.array([[0, 1, 2, 3]], np.uint64)
print(hamming(words, 0, words + np.uint64(1), 0))
"""


def test_kernels_run_on_a_read_only_home(tmp_path: Path) -> None:
    """Both numba and we test with a temporary file whether a folder is writable."""
    environment = {k: v for k, v in os.environ.items() if k != kernel_cache.VARIABLE}
    environment |= {"HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    code = READ_ONLY.format(temporary=str(tmp_path / "stereo-sfm-"))
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert child.returncode == 0, child.stderr
    assert child.stdout.strip() == "7"
    assert list(tmp_path.glob("stereo-sfm-*/*/*.nbi"))
