"""Pairing of left and right images, and counting of lost frames. Pure: no clock, no threads."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.types import U8

LEFT, RIGHT = 0, 1
_MAX_WAITING = 30  # images of one camera that wait for the other: a reader may be late by a second
_RELOCK = 3  # images that contradict the past but are mutually consistent restart the filter
_FIRST_STAMP_NS = 2_000_000_000  # maximum distance of the first image from the camera's clock
_MAX_GAP = 10_000  # frames; a larger step of a counter is corruption, not loss


@dataclass(frozen=True, eq=False)
class CameraImage:
    """The image of one camera as received."""

    stamp_ns: int  # camera clock
    counter: int  # the camera's frame number
    pixels: U8  # (H, W)
    exposure_us: float
    gain: float


@dataclass(frozen=True, eq=False)
class Pair:
    """Two simultaneous images."""

    left: CameraImage
    right: CameraImage
    dropped_before: int


class ContinuityFilter:
    """Rejects images whose counter and stamp contradict earlier ones (corrupt headers, stale transfers).

    Args:
        period_ns: nominal time between frames, 0 when the camera may choose another rate.
        now_ns: camera clock at the start, None when unknown.
    """

    def __init__(self, period_ns: int, now_ns: int | None) -> None:
        self._period_ns, self._now_ns = period_ns, now_ns
        self._last: CameraImage | None = None
        self._suspects: list[CameraImage] = []

    def accept(self, image: CameraImage) -> bool:
        """Whether the image is plausible."""
        if self._plausible(image):
            self._last, self._suspects = image, []
            return True
        if self._suspects and not self._follows(self._suspects[-1], image):
            self._suspects = []
        self._suspects.append(image)
        del self._suspects[:-_RELOCK]
        if len(self._suspects) >= _RELOCK and (self._last is None or image.stamp_ns > self._last.stamp_ns):
            self._last, self._suspects = image, []
            return True
        return False

    def _plausible(self, image: CameraImage) -> bool:
        if self._last is not None:
            return self._follows(self._last, image)
        return self._now_ns is None or abs(image.stamp_ns - self._now_ns) <= _FIRST_STAMP_NS

    def _follows(self, before: CameraImage, after: CameraImage) -> bool:
        """Whether counter and stamp agree on the number of frames between, or the stamp is that of the next frame."""
        steps, elapsed = after.counter - before.counter, after.stamp_ns - before.stamp_ns
        if elapsed <= 0:
            return False
        if not self._period_ns:
            return 1 <= steps <= _MAX_GAP
        agreed = 1 <= steps <= _MAX_GAP and periods(elapsed, self._period_ns) == steps
        return agreed or 0.5 < elapsed / self._period_ns < 1.5


def periods(elapsed_ns: int, period_ns: int) -> int:
    """Frames from one stamp to a later one; tolerates a clock error of 1 % over 50 frames."""
    return round(elapsed_ns / period_ns)


class Pairer:
    """Pairs images by stamp, with the counters as a check.

    Args:
        counters: for lost images.
        period_ns: nominal time between frames, 0 when the camera may choose another rate.
        tolerance_ns: maximum difference of the stamps of a pair.
        now_ns: camera clock at the start, None when unknown.
    """

    def __init__(
        self, counters: Counters, period_ns: int, tolerance_ns: int = 1_000_000, now_ns: int | None = None
    ) -> None:
        self._counters, self._period_ns, self._tolerance_ns = counters, period_ns, tolerance_ns
        self._locks = (ContinuityFilter(period_ns, now_ns), ContinuityFilter(period_ns, now_ns))
        self._waiting: tuple[deque[CameraImage], deque[CameraImage]] = (deque(), deque())
        self._alone: tuple[deque[int], deque[int]] = (deque(maxlen=_MAX_WAITING), deque(maxlen=_MAX_WAITING))
        self._last: Pair | None = None
        self._offset = 0  # left counter minus right counter

    def push(self, side: int, image: CameraImage) -> Pair | None:
        """Add an image of LEFT or RIGHT; returns the pair that it completes, if any."""
        if not self._locks[side].accept(image):
            self._counters.add("implausible")
            return None
        others = self._waiting[1 - side]
        while others and others[0].stamp_ns <= image.stamp_ns - self._tolerance_ns:
            self._give_up(1 - side, others.popleft())
        if not others or others[0].stamp_ns - image.stamp_ns >= self._tolerance_ns:
            self._waiting[side].append(image)
            if len(self._waiting[side]) > _MAX_WAITING:
                self._give_up(side, self._waiting[side].popleft())
            return None
        other = others.popleft()
        while self._waiting[side]:
            self._give_up(side, self._waiting[side].popleft())
        left, right = (image, other) if side == LEFT else (other, image)
        return self._emit(left, right)

    def _give_up(self, side: int, image: CameraImage) -> None:
        """`image` is unpaired; with the other camera's of that number unpaired too, the stamps differ too much."""
        number = self._number(side, image)
        self._counters.add("unpaired")
        if number in self._alone[1 - side]:
            self._counters.add("skewed")
        self._alone[side].append(number)

    def _number(self, side: int, image: CameraImage) -> int:
        """The counter in the numbering of the right camera."""
        return image.counter - self._offset if side == LEFT else image.counter

    def _emit(self, left: CameraImage, right: CameraImage) -> Pair:
        offset = left.counter - right.counter
        if offset != self._offset:
            self._counters.add("counter_mismatch")
            self._offset = offset
        pair = Pair(left, right, self._lost_before(left))
        self._last = pair
        return pair

    def _lost_before(self, left: CameraImage) -> int:
        """Frames lost since the last pair: by stamp if the rate is known, else by the counter."""
        if self._last is None:
            return 0
        last = self._last.left
        if self._period_ns:
            return max(0, periods(left.stamp_ns - last.stamp_ns, self._period_ns) - 1)
        return max(0, left.counter - last.counter - 1)
