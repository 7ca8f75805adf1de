"""A recording or the simulator played in real time like a live camera."""

from __future__ import annotations

import time
from collections.abc import Iterator

from stereo_sfm.drivers.source import Source
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import StereoImage


class PacedSource(WrappedSource):
    """Delays another source's frames according to their stamps, relative to the first one."""

    def __init__(self, source: Source, speed: float = 1.0) -> None:
        """Args: source, entered and left with this one; speed, 2 plays twice as fast.

        Raises:
            StereoSfmError: a speed that is not above 0.
        """
        if not speed > 0:
            raise StereoSfmError(f"the speed must be above 0 (1: real time), got {speed:g}")
        super().__init__(source)
        self._speed = speed

    @property
    def live(self) -> bool:
        return True

    def __iter__(self) -> Iterator[StereoImage]:
        first_ns: int | None = None
        begin = 0.0
        for image in self.source:
            now = time.monotonic()
            if first_ns is None:
                first_ns, begin = image.stamp_ns, now
            due = begin + (image.stamp_ns - first_ns) * 1e-9 / self._speed
            if due > now:
                time.sleep(due - now)
            yield image
