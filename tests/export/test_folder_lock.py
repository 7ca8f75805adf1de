"""A folder belongs to one run at a time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.run_folder import KEPT_MAP, prepare_folder
from stereo_sfm.maps.saved_map import map_files

OTHER = """
import sys, time
from pathlib import Path
from stereo_sfm.export.run_folder import prepare_folder
lock = prepare_folder(Path(sys.argv[1]), overwrite=True)
print("mine", flush=True)
time.sleep(600)
"""


def test_overwriting_an_active_run_is_an_error_and_changes_no_file(tmp_path: Path) -> None:
    other = subprocess.Popen([sys.executable, "-c", OTHER, str(tmp_path)], stdout=-1, text=True)
    assert other.stdout is not None and other.stdout.readline() == "mine\n"
    (tmp_path / "run.mcap").write_text("of the other")
    with pytest.raises(StereoSfmError, match=r"another run is writing to .*: choose another -o, or wait"):
        prepare_folder(tmp_path, overwrite=True)
    assert (tmp_path / "run.mcap").exists()
    os.kill(other.pid, signal.SIGKILL)
    other.wait()
    lock = prepare_folder(tmp_path, overwrite=True)  # a killed run holds nothing
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(StereoSfmError, match="another run is writing"):
        prepare_folder(tmp_path, overwrite=True)
    del lock
    prepare_folder(tmp_path, overwrite=True)


def test_an_overwritten_run_leaves_nothing_of_its_map(tmp_path: Path) -> None:
    (tmp_path / KEPT_MAP).mkdir()
    for name in (*map_files(), "notes.txt"):
        (tmp_path / KEPT_MAP / name).write_text("of the run before")
    prepare_folder(tmp_path, overwrite=True)
    assert [path.name for path in (tmp_path / KEPT_MAP).iterdir()] == ["notes.txt"]
