"""Ctrl-C reaches every process of the terminal, SIGTERM often the whole group; only the main process handles them."""

from __future__ import annotations

import signal
from collections.abc import Generator
from contextlib import contextmanager
from multiprocessing import resource_tracker

STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


@contextmanager
def ignored_by_children() -> Generator[None]:
    """Processes started in the `with` block ignore Ctrl-C from the start."""
    resource_tracker.ensure_running()  # where that starts its process, it lets signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
