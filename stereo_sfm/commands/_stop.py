"""Ctrl-C, SIGTERM and a closed terminal: the first asks to finish cleanly, the second interrupts."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self

from stereo_sfm.pipeline.interrupts import STOP_SIGNALS

INTERRUPTED = 130  # exit code, as shells give it for Ctrl-C


class StopRequest:
    """While entered, the first signal only sets `asked` and calls `then`; the loop ends at its next iteration."""

    def __init__(self, limit_s: float = 0.0) -> None:
        """Args: limit_s, seconds after which the first signal counts as the second; 0: never."""
        self.asked = False
        self._asked_s = 0.0  # monotonic clock
        self._limit_s = limit_s
        self.then: Callable[[], None] | None = None  # called in the handler: must be short
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (*STOP_SIGNALS, signal.SIGALRM):
            if (number, signal.getsignal(number)) != (signal.SIGHUP, signal.SIG_IGN):  # as set by nohup
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.finished()
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    @property
    def since_s(self) -> float:
        """Seconds since the first signal; 0 before."""
        return time.monotonic() - self._asked_s if self.asked else 0.0

    def finished(self) -> None:
        """The run has finished; the time limit no longer applies."""
        signal.setitimer(signal.ITIMER_REAL, 0.0)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked, self._asked_s = True, time.monotonic()
        signal.setitimer(signal.ITIMER_REAL, self._limit_s)
        with contextlib.suppress(OSError):  # the terminal may be gone
            print("\nfinishing (Ctrl-C again to abort)", file=sys.stderr)
        if self.then is not None:
            self.then()
