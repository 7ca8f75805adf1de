"""Stage times for reports. The core never reads a clock: its caller passes one of these, by default the null object."""

from __future__ import annotations

import functools
import time
from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stereo_sfm.kernel_cache import Compilation


class NoSpans:
    """Null object: measures nothing."""

    @contextmanager
    def span(self, name: str) -> Generator[None, None, None]:
        """Mark a stage called `name`."""
        yield

    def take(self) -> dict[str, float]:
        """Milliseconds per stage since the last call."""
        return {}


@functools.cache
def _compilation() -> Compilation:
    """Counts the seconds in which this process compiles kernels, from the first call on."""
    from stereo_sfm.kernel_cache import count_compilation

    return count_compilation()


class Spans(NoSpans):
    """Sums wall-clock milliseconds per stage name, without the time in which kernels are compiled in it."""

    def __init__(self) -> None:
        self._ms: dict[str, float] = {}
        self._compilation = _compilation()

    @contextmanager
    def span(self, name: str) -> Generator[None, None, None]:
        start, compiled = time.perf_counter(), self._compilation.seconds
        try:
            yield
        finally:
            seconds = time.perf_counter() - start - (self._compilation.seconds - compiled)
            self._ms[name] = self._ms.get(name, 0.0) + seconds * 1e3

    def take(self) -> dict[str, float]:
        ms, self._ms = self._ms, {}
        return ms
