"""Pairs that are missing from a recording: a right calibration stays as it is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from stereo_sfm.config import Config
from stereo_sfm.drivers.source import Source, open_source
from stereo_sfm.pipeline.inline import run_inline
from stereo_sfm.types import MapUpdate, StereoImage

MISSING = 50, 100, 101


class Without:
    """A source without some images."""

    def __init__(self, source: Source) -> None:
        self._source = source

    def __iter__(self) -> Iterator[StereoImage]:
        return (image for image in self._source if image.frame_id not in MISSING)

    def __getattr__(self, name: str) -> object:
        return getattr(self._source, name)


class Updates(list[MapUpdate]):
    def put(self, message: object) -> None:
        if isinstance(message, MapUpdate):
            self.append(message)


@pytest.mark.slow
def test_missing_pairs_correct_nothing(data_root: Path) -> None:
    """The two images after a gap were a 'step' of 0.12 deg and 0.18 deg of decentering: rows from 0.11 to 0.43 px."""
    updates = Updates()
    with open_source(data_root / "euroc_mh01") as source:
        without: Source = Without(source)  # type: ignore[assignment]
        frames = list(run_inline(without, Config(), (updates,)))
    assert len(frames) == 180 - len(MISSING)
    found = [update.calibration for update in updates if update.calibration is not None]
    assert not [c for c in found if c.why == "step"]
    rows = [update.row_errors for update in updates if update.row_errors is not None]
    assert rows and max(row.systematic_px for row in rows) < 0.2
