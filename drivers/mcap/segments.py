"""A recording's folder of segments as one source."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from stereo_sfm.drivers.mcap import IMAGES, McapOptions
from stereo_sfm.drivers.mcap.source import open_mcap
from stereo_sfm.drivers.source import BaseSource, Source, Stamps
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import visible
from stereo_sfm.types import StereoImage

log = logging.getLogger("stereo_sfm")


class SegmentsSource(BaseSource):
    """Plays the images of all segments, one after the other; each file is open only while it is read."""

    def __init__(self, folder: Path, options: McapOptions) -> None:
        """Raises StereoSfmError when no segment has images (any more), or one cannot be opened."""
        self._options = options
        self._files = [path for path in sorted(visible(folder, f"*{IMAGES}")) if path.stat().st_size]
        self.name, self._folder = str(folder), folder
        self.frame_count = 0
        rig = None
        for path in list(self._files):
            try:
                with self._open(path) as segment:
                    rig = rig or segment.rig
                    self.frame_count += segment.frame_count or 0
            except StereoSfmError as error:
                log.warning("left out: %s", error)
                self._files.remove(path)
        if rig is None:
            raise StereoSfmError(f"{folder} has no segment with images: they were deleted, or not recorded")
        self.rig = rig

    def _open(self, path: Path) -> Source:
        return open_mcap(str(path), self._options)

    def stamps(self) -> Stamps:
        parts: list[Stamps] = []
        for path in self._files:
            with self._open(path) as segment:
                parts += [s] if (s := segment.stamps()) is not None else []
        skew = max((p.skew_ms for p in parts), default=float("nan"))
        return Stamps(np.concatenate([np.zeros(0, np.int64), *(p.stamp_ns for p in parts)]), skew)

    def __iter__(self) -> Iterator[StereoImage]:
        for path in self._files:
            with self._open(path) as segment:
                yield from segment
