"""Images held in memory as a source: for tests, benchmarks, and programs that have their images already."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.source import BaseSource
from stereo_sfm.types import StereoImage, Trajectory

PERIOD_NS = 33_333_333  # of a repeated sequence: 30 Hz


class MemorySource(BaseSource):
    """Yields the images unchanged, or, with `count`, a longer sequence that repeats them."""

    def __init__(
        self,
        rig: Rig,
        images: Sequence[StereoImage],
        ground_truth: Trajectory | None = None,
        name: str = "memory",
        count: int | None = None,
        there_and_back: bool = False,
    ) -> None:
        """Args:
        rig, images, ground_truth, name: contents of the source.
        count: length of the repeated sequence, renumbered and stamped at 30 Hz; None yields the images once, unchanged.
        there_and_back: the repeated sequence reverses at the ends, so that it has no jump.
        """
        self.rig, self.images, self.ground_truth, self.name = rig, images, ground_truth, name
        self.frame_count = self._length = len(images) if count is None else count
        self._count, self._there_and_back = count, there_and_back

    def at(self, positions: Sequence[int]) -> Iterator[StereoImage]:
        return (self._frame(position) for position in positions)

    def __iter__(self) -> Iterator[StereoImage]:
        return (self._frame(k) for k in range(self._length))

    def _frame(self, k: int) -> StereoImage:
        if self._count is None:
            return self.images[k]
        n = len(self.images)
        period = max(2 * n - 2, 1) if self._there_and_back else n
        at = k % period
        image = self.images[at if at < n else period - at]
        return replace(image, frame_id=k, stamp_ns=1_000_000_000 + k * PERIOD_NS, dropped_before=0)
