"""An output that is a pipe is refused: opening it would wait for a reader, deaf to signals."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stereo_sfm as s
from stereo_sfm.calib import save_rig
from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.tables import write_table
from stereo_sfm.export.formats import export_map, export_trajectory
from stereo_sfm.log.whole_file import WholeFile
from stereo_sfm.maps.saved_map import save_map
from stereo_sfm.types import Trajectory
from tests.drivers.dataset_folders import make_images
from tests.maps.maps import small_map
from tests.synthetic import fisheye_rig

PATH = Trajectory(np.arange(2), np.tile(np.eye(4), (2, 1, 1)))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    make_images(tmp_path / "pairs")
    (tmp_path / "a.mcap").touch()
    save_map(small_map()[1], tmp_path / "map")
    save_rig(fisheye_rig(), tmp_path / "rig.yaml")
    for suffix in ("mcap", "yaml", "png", "csv", "tum", "rrd", "npz", "bin"):
        os.mkfifo(tmp_path / f"p.{suffix}")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        "record pairs -o p.mcap",
        "convert pairs -o p.mcap",
        "recover a.mcap -o p.mcap",
        "export map --format ply -o p.bin",
        "export map --format tum -o p.tum",
        "convert-calib rig.yaml p.yaml",
        "convert-calib rig.yaml b.yaml --wheel-output p.bin",
        "check-calib pairs --correct p.yaml",
        "mask pairs -o p.png",
        "viz map --save p.rrd",
        "vocabulary train a.mcap -o p.npz",
        "t265 firmware extract rig.yaml -o p.bin",
        "t265 firmware extract p.bin -o b",
    ],
)
def test_a_command_says_so_at_once(command: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command.split(), "--overwrite"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "it is not a file but a pipe" in line


WRITES: list[Callable[[Path], Any]] = [
    lambda p: save_rig(fisheye_rig(), p / "p.yaml"),
    lambda p: export_trajectory(PATH, p / "p.tum"),
    lambda p: export_map(s.load_map(p / "map"), p / "p.bin", "ply"),
    lambda p: write_table(p / "p", ("a",), [[1]]),
    lambda p: WholeFile(p / "p.mcap", overwrite=True),
]


@pytest.mark.parametrize("write", WRITES)
def test_a_program_is_told_so(write: Callable[[Path], Any], folder: Path) -> None:
    with pytest.raises(StereoSfmError, match="it is not a file but a pipe"):
        write(folder)


def test_standard_output_may_be_a_pipe(folder: Path) -> None:
    """As in `stereo-sfm convert-calib rig.yaml /dev/stdout | less`."""
    read, write = os.pipe()
    with os.fdopen(read, "rb") as reader:
        save_rig(fisheye_rig(), f"/dev/fd/{write}")
        os.close(write)
        assert reader.read() == (folder / "rig.yaml").read_bytes()
