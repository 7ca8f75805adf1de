"""How each stage keeps up: rate, queue, latency. Wall clock, so never part of what a run computes."""

from __future__ import annotations

import time

import numpy as np

from stereo_sfm.messages import Health

WINDOW = 90  # steps between two reports, and what they look back on


class HealthMeter:
    """Collects the duration of a stage's steps and reports every `WINDOW` of them."""

    def __init__(self, stage: str) -> None:
        self._stage = stage
        self._ms: list[float] = []
        self._since = time.monotonic()
        self.dropped = 0

    def add(self, frame_id: int, ms: float, waiting: int) -> Health | None:
        """One more step of `ms` milliseconds with `waiting` messages behind it; a report when one is due."""
        self._ms.append(ms)
        return self.report(frame_id, waiting) if len(self._ms) >= WINDOW else None

    def report(self, frame_id: int, waiting: int) -> Health | None:
        """What is known since the last report; None when nothing happened."""
        if not self._ms:
            return None
        now = time.monotonic()
        p50, p95, p99 = np.percentile(self._ms, (50, 95, 99))
        rate = len(self._ms) / max(now - self._since, 1e-9)
        self._ms, self._since = [], now
        return Health(self._stage, frame_id, rate, waiting, float(p50), float(p95), float(p99), self.dropped)
