"""The frames that an earlier run tracked, in their order: what it dropped is left out."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from types import TracebackType
from typing import Self

from calib.rig import Rig
from drivers.source import Source
from stereo_sfm.types import StereoImage, Trajectory


class ReplayedSource:
    """Passes on another source's frames whose ids are in `frame_ids`."""

    live = False

    def __init__(self, source: Source, frame_ids: Collection[int]) -> None:
        self._source, self._frame_ids = source, frozenset(frame_ids)

    @property
    def name(self) -> str:
        return self._source.name

    @property
    def rig(self) -> Rig:
        return self._source.rig

    @property
    def ground_truth(self) -> Trajectory | None:
        return self._source.ground_truth

    @property
    def frame_count(self) -> int | None:
        return len(self._frame_ids)

    def __enter__(self) -> Self:
        self._source.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._source.__exit__(kind, error, trace)

    def __iter__(self) -> Iterator[StereoImage]:
        return (image for image in self._source if image.frame_id in self._frame_ids)
