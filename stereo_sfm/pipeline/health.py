"""How each stage keeps up: rate, queue, latency. Wall clock, so never part of what a run computes."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from stereo_sfm.messages import Health

WINDOW = 90  # steps between two reports, and in each of them


class HealthMeter:
    """Collects the duration of a stage's steps and sends a report of every `WINDOW` of them."""

    def __init__(self, stage: str, send: Callable[[Health], object]) -> None:
        self._stage, self._send = stage, send
        self._ms: list[float] = []
        self._since = time.monotonic()
        self._frame_id = -1
        self.dropped = 0

    def add(self, frame_id: int, ms: float, waiting: int = 0) -> bool:
        """One more step of `ms` milliseconds with `waiting` messages behind it; whether a report was sent."""
        self._ms.append(ms)
        self._frame_id = frame_id
        return len(self._ms) >= WINDOW and self.report(waiting)

    def report(self, waiting: int = 0) -> bool:
        """Send a report of the steps since the last one; False if there were none."""
        if not self._ms:
            return False
        now = time.monotonic()
        p50, p95, p99 = np.percentile(self._ms, (50, 95, 99))
        rate = len(self._ms) / max(now - self._since, 1e-9)
        self._ms, self._since = [], now
        self._send(Health(self._stage, self._frame_id, rate, waiting, float(p50), float(p95), float(p99), self.dropped))
        return True
