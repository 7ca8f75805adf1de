"""Whether a recording tells that its rows were exposed one after the other."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drivers.source import open_source
from stereo_sfm.cli import main
from stereo_sfm.config import TrackerConfig
from stereo_sfm.tracking.readout import LEAST_FRAMES, ReadoutErrors, ReadoutSearch

WALK = "sim:aisle?camera=pinhole&size=320x200&start=60&frames=40&vibration=4"


def search(spec: str, told_s: float) -> ReadoutErrors:
    with open_source(spec) as source:
        found = ReadoutSearch(TrackerConfig(), dataclasses.replace(source.rig, readout_s=told_s))
        for image in source:
            found.add(image)
    return found.errors()


def test_a_rolling_shutter_that_the_calibration_does_not_know() -> None:
    found = search(f"{WALK}&readout=0.025", 0.0)
    assert found.gain > 0.3
    assert 0.01 <= found.best_s <= 0.03


def test_a_global_shutter_and_one_that_is_known() -> None:
    assert search(WALK, 0.0).best_s == 0.0
    assert search(f"{WALK}&readout=0.025", 0.025).best_s == 0.025


def test_too_few_frames_say_nothing() -> None:
    found = search(f"{WALK}&frames={LEAST_FRAMES}", 0.0)  # the first has no motion
    assert np.isnan(found.gain)
    assert found.best_s == 0.0


def test_check_calib_tells(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check-calib", f"{WALK}&readout=0.025"]) in (0, 3)
    told = capsys.readouterr().out
    assert "shutter: rows read within 25 ms; points are off by" in told
    assert "cannot be judged with a rolling shutter" in told
