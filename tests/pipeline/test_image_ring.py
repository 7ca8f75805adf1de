"""The ring has its memory or raises an error, and rings of killed runs are removed."""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.pipeline import images
from stereo_sfm.pipeline.images import SHARED, ImageLayout, ImageRing, remove_abandoned

LAYOUT = ImageLayout((240, 320), (240, 320), None)
OWNER = """
import time
from stereo_sfm.pipeline.images import ImageLayout, ImageRing
ring = ImageRing(ImageLayout((240, 320), (240, 320), None), 2)
print(ring.name, flush=True)
time.sleep(600)
"""


def test_the_ring_has_all_of_its_memory_before_the_first_image() -> None:
    ring = ImageRing(LAYOUT, 8)
    try:
        found = (SHARED / ring.name).stat()
        assert found.st_blocks * 512 >= 8 * LAYOUT.size
    finally:
        ring.close()
    assert not (SHARED / ring.name).exists()


def test_too_little_shared_memory_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int, offset: int, size: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before = set(SHARED.iterdir())
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(StereoSfmError, match=r"no room for 8 images \(1 MB\): No space left on device; make it larger"):
        ImageRing(LAYOUT, 8)
    assert set(SHARED.iterdir()) <= before


def test_shared_memory_beyond_a_limit_is_one_clear_line() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(StereoSfmError, match="no room for 8 images"):
            ImageRing(LAYOUT, 8)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_the_ring_of_a_killed_run_is_removed_by_the_next_and_that_of_a_living_one_is_not() -> None:
    owners = [
        subprocess.Popen([sys.executable, "-c", OWNER], stdout=-1, text=True, start_new_session=True) for _ in "ab"
    ]
    killed, living = [SHARED / (owner.stdout.readline().strip() if owner.stdout else "") for owner in owners]
    os.killpg(owners[0].pid, signal.SIGKILL)  # with Python's own resource tracker
    owners[0].wait()
    assert killed.is_file() and living.is_file()
    remove_abandoned(min_age_s=0.0)
    assert not killed.exists()
    assert living.is_file()
    owners[1].terminate()
    owners[1].wait()
    living.unlink(missing_ok=True)


def test_a_ring_that_is_being_made_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / f"{images.PREFIX}new").write_bytes(b"")
    remove_abandoned(tmp_path)
    assert list(tmp_path.iterdir())
    remove_abandoned(tmp_path, min_age_s=-1.0)
    assert not list(tmp_path.iterdir())
