"""Buffers between the threads that read the camera and the consumer."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

import numpy as np

from stereo_sfm.types import ImuSamples, WheelSamples

T = TypeVar("T")
_MAX_SAMPLES = 20_000  # about a minute and a half of inertial samples: older ones are discarded if not consumed


class Handoff(Generic[T]):
    """A bounded queue that discards its oldest item when full, and counts the discarded frames."""

    def __init__(self, size: int) -> None:
        self._items: deque[tuple[T, int]] = deque()
        self._size = size
        self._lost = 0
        self._failure: BaseException | None = None
        self._ready = threading.Condition()

    def put(self, item: T, weight: int = 1) -> None:
        """Add an item that counts as `weight` frames if discarded."""
        with self._ready:
            if len(self._items) >= self._size:
                self._lost += self._items.popleft()[1]
            self._items.append((item, weight))
            self._ready.notify()

    def fail(self, error: BaseException) -> None:
        """End of the producer: the consumer gets the remaining items, then this error."""
        with self._ready:
            self._failure = self._failure or error
            self._ready.notify()

    def get(self, timeout_s: float) -> tuple[T, int] | None:
        """The oldest item and the number of frames discarded before it; None on timeout."""
        with self._ready:
            self._ready.wait_for(lambda: self._items or self._failure, timeout_s)
            if not self._items:
                if self._failure is not None:
                    raise self._failure
                return None
            lost, self._lost = self._lost, 0
            return self._items.popleft()[0], lost


class MotionBuffer:
    """Inertial samples waiting for the next image."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._rows: deque[tuple[int, bool, tuple[float, float, float]]] = deque(maxlen=_MAX_SAMPLES)

    def add(self, stamp_ns: int, is_gyro: bool, xyz: tuple[float, float, float]) -> None:
        with self._lock:
            self._rows.append((stamp_ns, is_gyro, xyz))

    def take(self, until_ns: int) -> ImuSamples | None:
        """Samples up to a stamp, in temporal order; None when there are none."""
        with self._lock:
            taken = sorted(r for r in self._rows if r[0] <= until_ns)
            kept = [r for r in self._rows if r[0] > until_ns]
            self._rows = deque(kept, maxlen=_MAX_SAMPLES)
        if not taken:
            return None
        xyz = np.array([r[2] for r in taken])
        is_gyro = np.array([r[1] for r in taken])[:, None]
        stamps = np.array([r[0] for r in taken], np.int64)
        return ImuSamples(stamps, np.where(is_gyro, xyz, np.nan), np.where(is_gyro, np.nan, xyz))


class WheelBuffer:
    """Wheel odometry pushed by another program, waiting for the next image."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._rows: deque[tuple[int, tuple[float, ...], tuple[float, ...]]] = deque(maxlen=_MAX_SAMPLES)

    def add(self, stamp_ns: int, linear: tuple[float, ...], angular: tuple[float, ...]) -> None:
        with self._lock:
            self._rows.append((stamp_ns, linear, angular))

    def take(self, until_ns: int) -> WheelSamples | None:
        """Samples up to a stamp, in temporal order; None when there are none."""
        with self._lock:
            taken = sorted(r for r in self._rows if r[0] <= until_ns)
            self._rows = deque((r for r in self._rows if r[0] > until_ns), maxlen=_MAX_SAMPLES)
        if not taken:
            return None
        stamps = np.array([r[0] for r in taken], np.int64)
        return WheelSamples(stamps, np.array([r[1] for r in taken], float), np.array([r[2] for r in taken], float))
