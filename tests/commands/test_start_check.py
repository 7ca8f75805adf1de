"""A run that begins with a wrong calibration: corrected, reported, and the same in every wiring and in its replay."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import stereo_sfm as s
from stereo_sfm.calib import save_rig
from stereo_sfm.cli import main
from stereo_sfm.geometry import se3

SPEC = "sim:aisle?camera=pinhole&size=320x200&rate=10&frames=14"
OPTIONS = ["-q", "--max-lost", "100", "--set", "tracker.max_features=100"]


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration file of a rig whose right camera is turned by 1.5 degrees about x."""
    with s.open_source(SPEC) as source:
        rig = source.rig
    path = tmp_path_factory.mktemp("wrong") / "rig.yaml"
    save_rig(replace(rig, left_T_right=rig.left_T_right @ se3.exp(np.deg2rad([0, 0, 0, 1.5, 0, 0]))), path)
    return path


def run(wrong: Path, folder: Path, *options: str) -> dict[str, object]:
    assert main(["run", SPEC, "--rig", str(wrong), "-o", str(folder), *OPTIONS, *options]) == 0
    return json.loads((folder / "stats.json").read_text())


def test_the_run_is_corrected_and_every_wiring_and_the_replay_agree(
    wrong: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inline = run(wrong, tmp_path / "a", "--inline")
    assert inline["tracked"] == 14
    assert "turned by -1.5" in (tmp_path / "a" / "report.md").read_text()
    with s.open_source(SPEC) as source:
        away = se3.inverse(source.rig.left_T_right) @ s.load_rig(tmp_path / "a" / "rig.yaml").left_T_right
    assert np.rad2deg(se3.extent(away)[1]) < 0.05
    processes = run(wrong, tmp_path / "b", "--log", "full")
    assert processes["fingerprint"] == inline["fingerprint"]
    capsys.readouterr()
    for name in "ab":  # without and with logged images
        assert main(["replay", str(tmp_path / name), "-o", str(tmp_path / f"{name}2"), "--check", "-q"]) == 0
        assert capsys.readouterr().out == "identical\n"


def test_info_says_it(wrong: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", SPEC, "--rig", str(wrong), "-o", str(tmp_path / "x.mcap"), "-q"]) == 0
    capsys.readouterr()
    assert main(["info", str(tmp_path / "x.mcap")]) == 0
    out = capsys.readouterr().out
    assert "problem: the right camera is turned by -1.5" in out and "check-calib" in out


def test_a_live_camera_is_opened_again(wrong: Path, tmp_path: Path) -> None:
    """What is live is told its images are not waited for: the run begins again with what the first of them fit."""
    folder = tmp_path / "live"
    spec = f"{SPEC}&realtime=true"
    assert main(["run", spec, "--rig", str(wrong), "-o", str(folder), *OPTIONS, "--log", "full"]) == 0
    stats = json.loads((folder / "stats.json").read_text())
    assert stats["start_check"]["corrected"] and stats["tracked"] > 0
