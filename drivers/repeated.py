"""A recording or the simulator again and again, as one camera that never ends."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

from stereo_sfm.drivers.source import Source
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.types import StereoImage


class RepeatedSource(WrappedSource):
    """Frame ids and stamps go on where the round before ended, one frame interval later."""

    def __init__(self, source: Source) -> None:
        super().__init__(source)

    @property
    def frame_count(self) -> None:
        return None

    @property
    def ground_truth(self) -> None:
        return None

    def __iter__(self) -> Iterator[StereoImage]:
        ids, shift_ns = itertools.count(), 0
        while True:
            first = before = last = None
            for image in self.source:
                if first is None:
                    first = image.stamp_ns
                before, last = last, image.stamp_ns
                yield shifted(image, next(ids), shift_ns)
            if first is None or before is None or last is None:
                return  # fewer than two images: no interval
            shift_ns += last - first + (last - before)


def shifted(image: StereoImage, frame_id: int, shift_ns: int) -> StereoImage:
    """The image with another number, and with its samples at later times."""
    imu, wheel = image.imu, image.wheel
    return replace(
        image,
        frame_id=frame_id,
        stamp_ns=image.stamp_ns + shift_ns,
        right_stamp_ns=image.right_stamp_ns + shift_ns if image.right_stamp_ns else 0,
        imu=None if imu is None else imu.shifted(shift_ns),
        wheel=None if wheel is None else wheel.shifted(shift_ns),
    )
