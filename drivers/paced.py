"""A recording or the simulator as if it were a live camera: every frame comes at its time, taken or not."""

from __future__ import annotations

import time
from collections.abc import Iterator
from types import TracebackType
from typing import Self

from calib.rig import Rig
from drivers.source import Source
from stereo_sfm.types import StereoImage, Trajectory


class PacedSource:
    """Passes on another source's frames no earlier than their stamps say, counted from the first one."""

    def __init__(self, source: Source, speed: float = 1.0) -> None:
        """Args: source, entered and left with this one; speed, 2 plays twice as fast."""
        self._source, self._speed = source, speed

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
        return self._source.frame_count

    @property
    def live(self) -> bool:
        return True

    @property
    def counters(self) -> dict[str, float]:
        """What a live source counts about itself (drivers.live.counters); empty for files."""
        return getattr(self._source, "counters", {})

    def __enter__(self) -> Self:
        self._source.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._source.__exit__(kind, error, trace)

    def __iter__(self) -> Iterator[StereoImage]:
        first_ns: int | None = None
        begin = 0.0
        for image in self._source:
            now = time.monotonic()
            if first_ns is None:
                first_ns, begin = image.stamp_ns, now
            due = begin + (image.stamp_ns - first_ns) * 1e-9 / self._speed
            if due > now:
                time.sleep(due - now)
            yield image
