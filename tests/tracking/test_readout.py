"""Whether a recording tells that its rows were exposed one after the other."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib import load_rig, save_rig
from stereo_sfm.cli import main
from stereo_sfm.config import TrackerConfig
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow.readout import LEAST_FRAMES, LEAST_GAIN, ReadoutErrors, ReadoutSearch
from stereo_sfm.types import StereoImage

WALK = "sim:aisle?camera=pinhole&size=320x200&start=60&frames=40&vibration=4"


def search(spec: str, told_s: float, yaw_deg: float = 0.0, most: int = 200) -> ReadoutErrors:
    """The right camera is believed to be turned by `yaw_deg` more than it is."""
    with open_source(spec) as source:
        turn = se3.exp(np.array([0, 0, 0, 0, np.radians(yaw_deg), 0]))
        rig = dataclasses.replace(source.rig, readout_s=told_s, left_T_right=source.rig.left_T_right @ turn)
        found = ReadoutSearch(TrackerConfig(), rig)
        for image in itertools.islice(source, most):
            found.add(image)
    return found.errors()


def test_a_rolling_shutter_that_the_calibration_does_not_know() -> None:
    found = search(f"{WALK}&readout=0.025", 0.0)
    assert found.gain > 0.3
    assert 0.01 <= found.best_s <= 0.03


def test_a_global_shutter_and_one_that_is_known() -> None:
    assert search(WALK, 0.0).best_s == 0.0
    assert search(f"{WALK}&readout=0.025", 0.025).best_s == 0.025


def test_a_global_shutter_with_a_wrong_calibration_is_no_rolling_one() -> None:
    """Driving ahead, wrong disparities look like rows that are read one after the other."""
    found = search("sim:aisle?camera=pinhole&size=320x200&start=60&frames=60&rate=10", 0.0, -0.4)
    assert found.gain > LEAST_GAIN  # the fit alone would say that it is a rolling one
    assert found.explained_otherwise
    assert found.best_s == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("yaw_deg", [-0.1, -0.05, 0.0, 0.05, 0.1])
def test_kitti_has_a_global_shutter(yaw_deg: float, data_root: Path) -> None:
    assert search(f"kitti:{data_root / 'kitti'}", 0.0, yaw_deg, 100).best_s == 0.0


def test_too_few_frames_say_nothing() -> None:
    found = search(f"{WALK}&frames={LEAST_FRAMES}", 0.0)  # the first has no motion
    assert np.isnan(found.gain)
    assert found.best_s == 0.0


def test_a_camera_that_glides_shows_no_readout() -> None:
    assert search(f"{WALK}&vibration=0&readout=0.025", 0.0).best_s == 0.0
    assert search(f"{WALK}&readout=0.025", 0.0).shown


def test_check_calib_tells(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    source = f"{WALK}&readout=0.025"
    assert main(["check-calib", source, "--correct", str(tmp_path / "corrected.yaml")]) in (0, 3)
    told = capsys.readouterr().out
    assert "shutter: rows read within 25 ms; points are off by" in told
    assert "cannot be judged with a rolling shutter" in told
    with open_source(source) as opened:
        rig = opened.rig
    corrected = load_rig(tmp_path / "corrected.yaml")
    assert corrected.left.fx == rig.left.fx  # of what cannot be judged nothing is changed
    assert corrected.left_T_right[1, 3] == pytest.approx(rig.left_T_right[1, 3], abs=1e-12)
    save_rig(dataclasses.replace(rig, readout_s=0.0), tmp_path / "silent.yaml")
    assert main(["check-calib", source, "--rig", str(tmp_path / "silent.yaml")]) == 0
    told = capsys.readouterr().out
    assert "WARN  shutter: all rows at once, but points fit" in told
    assert "set readout_s in rig.yaml" in told
    assert "cannot be judged with a rolling shutter" in told
    save_rig(dataclasses.replace(rig, readout_s=0.1), tmp_path / "long.yaml")
    assert main(["check-calib", source, "--rig", str(tmp_path / "long.yaml")]) == 0
    assert "check readout_s in rig.yaml" in capsys.readouterr().out


def test_check_calib_of_a_pair_that_misses_right_images(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = SimSource.frame

    def without(self: SimSource, frame_id: int, dropped_before: int = 0) -> StereoImage:
        image = frame(self, frame_id, dropped_before)
        return dataclasses.replace(image, right=None) if frame_id % 15 == 0 else image

    monkeypatch.setattr(SimSource, "frame", without)
    assert main(["check-calib", WALK]) in (0, 3)
