"""The frames that an earlier run tracked, in order, without those it dropped."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from stereo_sfm.drivers.source import Source
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.types import StereoImage


class ReplayedSource(WrappedSource):
    """Passes on another source's frames whose ids are in `frame_ids`, with the samples of those between."""

    def __init__(self, source: Source, frame_ids: Collection[int]) -> None:
        super().__init__(source)
        self._frame_ids = frozenset(frame_ids)

    @property
    def live(self) -> bool:
        return False

    @property
    def frame_count(self) -> int | None:
        return len(self._frame_ids)

    def __iter__(self) -> Iterator[StereoImage]:
        left_out: list[StereoImage] = []
        last = max(self._frame_ids, default=-1)
        for image in self.source:
            if image.frame_id in self._frame_ids:
                yield image.following(left_out)
                left_out = []
            else:
                left_out.append(image.without_pixels())
            if image.frame_id >= last:  # what follows may be damaged, or take hours
                return
