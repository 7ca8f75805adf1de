"""Self-calibration of real recordings: a good rig stays, and one on a mount that gives has no steps."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from stereo_sfm import config as configuration
from stereo_sfm.drivers.source import open_source
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.pipeline.run import run
from stereo_sfm.types import StereoImage

MISSING = frozenset({50, 100, 101})  # frames


class WithGaps(WrappedSource):
    """Without some frames."""

    def __iter__(self) -> Iterator[StereoImage]:
        for number, image in enumerate(self.source):
            if number not in MISSING:
                yield image


def corrections(folder: Path) -> list[str]:
    """Why each correction was made."""
    config = configuration.load(None, ["loop.enabled=false"])
    record = RunRecord.of(config)
    with WithGaps(open_source(str(folder))) as source:
        for _ in run(source, config, [record]):
            pass
    return [c.why for c in record.calibrations]


@pytest.mark.slow
def test_a_good_rig_stays_where_frames_are_missing(data_root: Path) -> None:
    assert not corrections(data_root / "euroc_mh01")


@pytest.mark.slow
def test_a_mount_that_gives_has_no_steps(data_root: Path) -> None:
    """Rows of this pair shift by half a pixel and back in turns."""
    assert "step" not in corrections(data_root / "karlsruhe_part")
