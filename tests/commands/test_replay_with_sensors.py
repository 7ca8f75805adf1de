"""Samples of IMU and wheels through every way of running: the same bits."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib import load_rig, save_rig
from stereo_sfm.cli import main
from stereo_sfm.drivers.source import open_source
from tests.sensor_drive import miscalibrated

SPEC = "sim:loop?size=212x200&rate=10&start=60&frames=32&imu=t265&wheel=differential&dark=8-8.5"


@pytest.mark.parametrize("live", [(), ("--realtime",), ("--start", "0.5", "--frame-skip", "2")])
def test_a_run_over_processes_is_replayed_inline(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], live: tuple[str, ...]
) -> None:
    assert main(["run", SPEC, "-o", str(tmp_path / "run"), "-q", "--max-lost", "100", *live]) == 0
    capsys.readouterr()
    assert main(["replay", str(tmp_path / "run"), "-o", str(tmp_path / "again"), "--check", "--inline", "-q"]) == 0
    assert "identical" in capsys.readouterr().out
    states = json.loads((tmp_path / "run" / "stats.json").read_text())["states"]
    assert live or states["INERTIAL"] == 5  # the dark is bridged


def test_asking_for_a_calibration_that_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec = "sim:loop?size=212x200&rate=6&frames=12"
    assert main(["run", spec, "-o", str(tmp_path / "a"), "--calibrate-sensors", "--inline"]) == 0
    assert "IMU and wheels are not calibrated: the source has none" in capsys.readouterr().out
    assert main(["run", spec, "-o", str(tmp_path / "b"), "--calibrate-sensors", "--odometry", "em-r"]) == 2
    assert "for the default tracker" in capsys.readouterr().err


def test_a_wrong_calibration_of_the_sensors_is_corrected_while_driving(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = "sim:loop?size=212x200&rate=6&frames=140&imu=t265&wheel=differential&wheel_grade=ideal&imu_offset_ms=30"
    with open_source(spec) as source:
        true = source.rig
    assert true.imu is not None and true.wheel is not None
    save_rig(miscalibrated(true, np.zeros(3), 0.0, 0.04), tmp_path / "wrong.yaml")
    args = ["run", spec, "--rig", str(tmp_path / "wrong.yaml"), "-o", str(tmp_path / "run"), "--calibrate-sensors"]
    assert main(args) == 0
    assert "IMU time offset: offset +" in capsys.readouterr().out.replace("\n", " ")
    found = load_rig(tmp_path / "run" / "rig_corrected.yaml")
    assert found.imu is not None and found.wheel is not None
    assert found.imu.offset_s == pytest.approx(0.03, abs=1.5e-3)
    assert np.mean(found.wheel.radii_m) == pytest.approx(np.mean(true.wheel.radii_m), rel=1e-2)
    assert main(["replay", str(tmp_path / "run"), "-o", str(tmp_path / "again"), "--check", "--inline", "-q"]) == 0
    assert "identical" in capsys.readouterr().out
