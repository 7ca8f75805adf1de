"""Names of folders that are not UTF-8, as old disks have them, in whatever is written about them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.cli import main
from stereo_sfm.drivers import open_source
from stereo_sfm.errors import StereoSfmError, printable
from stereo_sfm.eval import batch
from stereo_sfm.eval.tables import write_table
from stereo_sfm.log import foxglove
from stereo_sfm.log.provenance import METADATA
from stereo_sfm.log.reader import LogReader
from stereo_sfm.maps.saved_map import save_map
from stereo_sfm.maps.store import lock
from stereo_sfm.pixels import write_image
from tests.drivers.dataset_folders import make_images
from tests.maps.maps import small_map
from tests.synthetic import fisheye_rig

ODD = os.fsdecode(b"m\xe4rz")  # of ISO 8859-1
SHOWN = "m\N{REPLACEMENT CHARACTER}rz"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    try:
        make_images(tmp_path / "images").rename(tmp_path / ODD)
    except OSError:
        pytest.skip("a file system of UTF-8 alone")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("log", ["full", "none"])
def test_a_run_and_its_report(folder: Path, log: str) -> None:
    assert main(["run", ODD, "--inline", "-q", "--max-lost", "101", "--log", log, "-o", f"out{ODD}"]) == 4
    assert "m?rz" in (folder / f"out{ODD}" / "report.md").read_text("utf-8")
    assert "m?rz" in (folder / f"out{ODD}" / "report.html").read_text("utf-8")
    if log == "full":
        with LogReader(folder / f"out{ODD}" / "run.mcap") as reader:
            assert SHOWN in reader.metadata(METADATA)["source"]


def test_a_recording(folder: Path) -> None:
    assert main(["record", ODD, "-q", "-o", f"{ODD}.mcap"]) == 0
    with LogReader(folder / f"{ODD}.mcap") as reader:
        assert SHOWN in reader.metadata(METADATA)["source"]


def test_a_configuration(folder: Path) -> None:
    """Its text is in the log."""
    words = ["run", ODD, "--inline", "-q", "--max-lost", "101", "--set", "loop.enabled=false", "-o", "out"]
    assert main([*words, "--set", f"loop.vocabulary={ODD}"]) == 4
    assert "m?rz" in (folder / "out" / "config.toml").read_text("utf-8")


def test_tables_and_lines_of_a_log(tmp_path: Path) -> None:
    write_table(tmp_path / "t", ("name",), [[ODD]])
    assert SHOWN in (tmp_path / "t.csv").read_text("utf-8")
    batch.write_results([batch.table_row("a", {"ok": False, "error": f"no {ODD}"})], tmp_path)
    assert SHOWN in (tmp_path / "results.md").read_text("utf-8")
    assert foxglove.text(0, "INFO", f"cannot read {ODD}").message == f"cannot read {SHOWN}"
    assert printable("m\N{LATIN SMALL LETTER A WITH DIAERESIS}rz") == "m\N{LATIN SMALL LETTER A WITH DIAERESIS}rz"


def test_pictures(folder: Path) -> None:
    """OpenCV's own writing of files would end the process."""
    write_image(folder / ODD / "a.png", np.zeros((4, 4), np.uint8))
    assert (folder / ODD / "a.png").read_bytes().startswith(b"\x89PNG")
    save_map(small_map()[1], folder / ODD / "store")
    assert main(["map", "plan", f"{ODD}/store"]) == 0
    assert main(["export", f"{ODD}/store", "--format", "floor-plan", "-o", f"{ODD}.png"]) == 0
    assert (folder / f"{ODD}.png").stat().st_size > 0
    with lock(folder / ODD / "store"):
        assert (folder / ODD / "store.versions").is_dir()


def test_plots(folder: Path) -> None:
    run = f"out{ODD}"
    assert main(["run", "sim:loop?size=160x120&frames=6", "--inline", "-q", "-o", run]) == 0
    shutil.copytree(folder / run, folder / "out2")
    assert main(["compare", run, "out2", "-o", "page"]) == 0
    path = (folder / run / "trajectory_odom.tum").rename(folder / f"{ODD}.tum")
    assert main(["eval", str(path), "--ref", str(path), "--plot", f"{ODD}_plot"]) == 0


@pytest.mark.parametrize("kind", ["video", "uvc"])
def test_a_video(kind: str, tmp_path: Path) -> None:
    """OpenCV would end the process."""
    if kind == "video":
        (tmp_path / ODD).touch()
    with pytest.raises(StereoSfmError, match="cannot open a name that is not UTF-8"):
        open_source(f"{kind}:{tmp_path / ODD}", fisheye_rig())
