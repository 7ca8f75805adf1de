"""Numbers of the running pipeline, collected for a report every second."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections import Counter, deque
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stereo_sfm.messages import Health, SourceCounters, StageTimes
from stereo_sfm.service.messages import HealthReport
from stereo_sfm.types import Dropped, MapUpdate

WINDOW = 300  # frames


class HealthCollector:
    """Collects numbers from the messages of the pipeline; `report` summarizes them."""

    def __init__(self) -> None:
        self._stages: dict[str, Health] = {}
        self._latency_ms: deque[float] = deque(maxlen=WINDOW)
        self._arrived: deque[float] = deque(maxlen=WINDOW)
        self._dropped: Counter[str] = Counter()
        self._counters: dict[str, float] = {}
        self._row_error_px = float("nan")
        self.restarts = 0

    def put(self, message: object) -> None:
        """Any message of a run."""
        if isinstance(message, StageTimes):
            if "latency" in message.ms:
                self._latency_ms.append(message.ms["latency"])
                self._arrived.append(time.monotonic())
        elif isinstance(message, Health):
            self._stages[message.stage] = message
        elif isinstance(message, Dropped):
            self._dropped[message.where] += message.count
        elif isinstance(message, SourceCounters):
            self._counters = message.counts
        elif isinstance(message, MapUpdate) and message.row_errors is not None:
            self._row_error_px = message.row_errors.systematic_px

    def report(self, pids: Mapping[str, int], disk: Path, recording_bytes: int) -> HealthReport:
        """The state now.

        Args:
            pids: processes by name. disk: a folder on the disk that is written to. recording_bytes: of recordings.
        """
        now, latency = time.monotonic(), list(self._latency_ms) or [float("nan")]
        recent = sum(now - t <= 2.0 for t in list(self._arrived))
        p50, p95 = np.percentile(latency, (50, 95)).tolist()
        return HealthReport(
            unix_ns=time.time_ns(),
            stages=dict(self._stages),
            rate_hz=recent / 2.0,
            latency_ms=(p50, p95),
            dropped=dict(self._dropped),
            counters=dict(self._counters),
            disk_free=free_bytes(disk),
            recording_bytes=recording_bytes,
            rss={name: rss(pid) for name, pid in pids.items()},
            restarts=self.restarts,
            row_error_px=self._row_error_px,
        )


def free_bytes(folder: Path) -> int:
    """Free space of the disk of a folder, which need not exist yet; 0 where that is not known."""
    for place in (folder, *folder.absolute().parents):
        with contextlib.suppress(OSError):  # it does not exist, or others may not search it
            return shutil.disk_usage(place).free
    return 0


def rss(pid: int) -> int:
    """Resident bytes of a process; 0 where that is not known."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError):
        return 0
