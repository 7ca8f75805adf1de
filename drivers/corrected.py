"""A source with the corrected calibration of its camera."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from stereo_sfm.calib.camera_store import CameraStore
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.source import Source, Stamps
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.types import StereoImage


class CorrectedSource(WrappedSource):
    """Wraps a source; `rig` is the one that an earlier run corrected, where there is one for the camera's serial."""

    def __init__(self, source: Source, store: Path) -> None:
        super().__init__(source)
        self._store = CameraStore(store)
        self._original: Rig | None = None
        self._rig: Rig | None = None

    @property
    def rig(self) -> Rig:
        rig = self.source.rig  # a camera's is known once it is open
        if self._rig is None or rig is not self._original:
            self._original, self._rig = rig, self._store.corrected(rig)
        return self._rig

    def stamps(self) -> Stamps | None:
        return self.source.stamps()

    def at(self, positions: Sequence[int]) -> Iterator[StereoImage]:
        return self.source.at(positions)
