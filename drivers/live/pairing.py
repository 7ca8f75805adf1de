"""Which two images are one stereo pair, and what was lost before it. Pure: no clock, no threads."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.types import U8

LEFT, RIGHT = 0, 1
_MAX_WAITING = 30  # images of one eye that may wait for the other: a reader may be late by a second
_RELOCK = 3  # so many images that contradict the past but not each other are the new truth
_FIRST_STAMP_NS = 2_000_000_000  # the first image must be this close to the camera's own clock
_MAX_GAP = 10_000  # frames; a larger step of a counter is damage, not loss


@dataclass(frozen=True, eq=False)
class Eye:
    """One eye's image as the camera sent it."""

    stamp_ns: int  # camera clock
    counter: int  # the camera's own number
    pixels: U8  # (H, W)
    exposure_us: float
    gain: float


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images of one moment."""

    left: Eye
    right: Eye
    dropped_before: int


class EyeLock:
    """Refuses images whose counter and time contradict those before (damaged headers, stale transfers).

    Args:
        period_ns: nominal time between frames, 0 when the camera may choose another rate.
        now_ns: camera clock at the start, None when unknown.
    """

    def __init__(self, period_ns: int, now_ns: int | None) -> None:
        self._period_ns, self._now_ns = period_ns, now_ns
        self._last: Eye | None = None
        self._suspects: list[Eye] = []

    def accept(self, eye: Eye) -> bool:
        """Whether to use the image."""
        if self._plausible(eye):
            self._last, self._suspects = eye, []
            return True
        if self._suspects and not self._follows(self._suspects[-1], eye):
            self._suspects = []
        self._suspects.append(eye)
        if len(self._suspects) >= _RELOCK and (self._last is None or eye.stamp_ns > self._last.stamp_ns):
            self._last, self._suspects = eye, []
            return True
        return False

    def _plausible(self, eye: Eye) -> bool:
        if self._last is not None:
            return self._follows(self._last, eye)
        return self._now_ns is None or abs(eye.stamp_ns - self._now_ns) <= _FIRST_STAMP_NS

    def _follows(self, before: Eye, after: Eye) -> bool:
        """Counter and time agree on how many frames lie between, or time says that it is the very next one."""
        steps, elapsed = after.counter - before.counter, after.stamp_ns - before.stamp_ns
        if elapsed <= 0:
            return False
        if not self._period_ns:
            return 1 <= steps <= _MAX_GAP
        agreed = 1 <= steps <= _MAX_GAP and periods(elapsed, self._period_ns) == steps
        return agreed or 0.5 < elapsed / self._period_ns < 1.5


def periods(elapsed_ns: int, period_ns: int) -> int:
    """Frames from one stamp to a later one; a clock that is 1 % off is still understood for 50 frames."""
    return round(elapsed_ns / period_ns)


class Pairer:
    """Pairs by time, with the counters as witness.

    Args:
        counters: where to count what is lost.
        period_ns: nominal time between frames, 0 when the camera may choose another rate.
        tolerance_ns: the eyes of one pair differ by less.
        now_ns: camera clock at the start, None when unknown.
    """

    def __init__(
        self, counters: Counters, period_ns: int, tolerance_ns: int = 1_000_000, now_ns: int | None = None
    ) -> None:
        self._counters, self._period_ns, self._tolerance_ns = counters, period_ns, tolerance_ns
        self._locks = (EyeLock(period_ns, now_ns), EyeLock(period_ns, now_ns))
        self._waiting: tuple[deque[Eye], deque[Eye]] = (deque(), deque())
        self._alone: tuple[deque[int], deque[int]] = (deque(maxlen=_MAX_WAITING), deque(maxlen=_MAX_WAITING))
        self._last: Pair | None = None
        self._offset = 0  # left counter minus right counter

    def push(self, side: int, eye: Eye) -> Pair | None:
        """Take one image of LEFT or RIGHT; a pair when it completes one."""
        if not self._locks[side].accept(eye):
            self._counters.add("implausible")
            return None
        others = self._waiting[1 - side]
        while others and others[0].stamp_ns <= eye.stamp_ns - self._tolerance_ns:
            self._give_up(1 - side, others.popleft())
        if not others or others[0].stamp_ns - eye.stamp_ns >= self._tolerance_ns:
            self._waiting[side].append(eye)
            if len(self._waiting[side]) > _MAX_WAITING:
                self._give_up(side, self._waiting[side].popleft())
            return None
        other = others.popleft()
        while self._waiting[side]:
            self._give_up(side, self._waiting[side].popleft())
        left, right = (eye, other) if side == LEFT else (other, eye)
        return self._emit(left, right)

    def _give_up(self, side: int, eye: Eye) -> None:
        """`eye` stays alone. Where the other eye's image of that number stays alone too, the two came too far apart."""
        number = self._number(side, eye)
        self._counters.add("unpaired")
        if number in self._alone[1 - side]:
            self._counters.add("skewed")
        self._alone[side].append(number)

    def _number(self, side: int, eye: Eye) -> int:
        """The counter both eyes agree on."""
        return eye.counter - self._offset if side == LEFT else eye.counter

    def _emit(self, left: Eye, right: Eye) -> Pair:
        offset = left.counter - right.counter
        if offset != self._offset:
            self._counters.add("counter_mismatch")
            self._offset = offset
        pair = Pair(left, right, self._lost_before(left))
        self._last = pair
        return pair

    def _lost_before(self, left: Eye) -> int:
        """Frames lost since the last pair: by time where the rate is known, else by the counter."""
        if self._last is None:
            return 0
        last = self._last.left
        if self._period_ns:
            return max(0, periods(left.stamp_ns - last.stamp_ns, self._period_ns) - 1)
        return max(0, left.counter - last.counter - 1)
