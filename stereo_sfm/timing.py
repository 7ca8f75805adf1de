"""Stage times for reports. The core never reads a clock: its caller passes one of these, by default the null object."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager


class NoSpans:
    """Null object: measures nothing."""

    @contextmanager
    def span(self, name: str) -> Generator[None, None, None]:
        """Mark a stage called `name`."""
        yield

    def take(self) -> dict[str, float]:
        """Milliseconds per stage since the last call."""
        return {}


class Spans(NoSpans):
    """Sums wall-clock milliseconds per stage name."""

    def __init__(self) -> None:
        self._ms: dict[str, float] = {}

    @contextmanager
    def span(self, name: str) -> Generator[None, None, None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self._ms[name] = self._ms.get(name, 0.0) + (time.perf_counter() - start) * 1e3

    def take(self) -> dict[str, float]:
        ms, self._ms = self._ms, {}
        return ms
