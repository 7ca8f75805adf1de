"""The whole run on real sequences: as accurate as it was measured to be, with mapping no worse than without."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from stereo_sfm.config import Config
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.evaluate import Evaluation, evaluate
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.pipeline.run import run


def evaluated(folder: Path, mapping: bool) -> Evaluation:
    """ATE of the map trajectory, or of bare odometry."""
    config = Config()
    if not mapping:
        config = dataclasses.replace(config, mapper=dataclasses.replace(config.mapper, enabled=False))
    record = RunRecord()
    with open_source(folder) as source:
        for _ in run(source, config, [record]):
            pass
        assert source.ground_truth is not None
        trajectory = record.mapped() if mapping else record.odometry()
        assert trajectory is not None
        return evaluate(trajectory, source.ground_truth)


@pytest.mark.slow
def test_drone_in_a_hall_is_within_4_5_mm(data_root: Path) -> None:
    """EuRoC MH01 part; the best of the peers has 4.6 mm."""
    mapped, bare = (evaluated(data_root / "euroc_mh01", mapping) for mapping in (True, False))
    assert mapped.ape_m.rmse < 0.0045
    assert mapped.ape_m.rmse < 1.05 * bare.ape_m.rmse


@pytest.mark.slow
def test_city_drive_is_within_0_35_percent(data_root: Path) -> None:
    """KITTI 00 part; the best of the peers has 0.35 %."""
    mapped, bare = (evaluated(data_root / "kitti", mapping) for mapping in (True, False))
    assert mapped.ate_percent < 0.35
    assert mapped.ape_m.rmse < 1.05 * bare.ape_m.rmse
