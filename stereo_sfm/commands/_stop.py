"""Ctrl-C and SIGTERM: the first asks to finish cleanly, the second interrupts."""

from __future__ import annotations

import signal
import sys
from types import FrameType, TracebackType
from typing import Any, Self

INTERRUPTED = 130  # exit code, as shells give it for Ctrl-C


class StopRequest:
    """While entered, the first SIGINT or SIGTERM only sets `asked`; the loop ends at its next round."""

    def __init__(self) -> None:
        self.asked = False
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        print("\nfinishing (once more to abort)", file=sys.stderr)
