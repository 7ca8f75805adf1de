"""Memory that a process frees goes back to the system, where the C library is glibc."""

from __future__ import annotations

import contextlib
import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # malloc.h
LARGE_BYTES = 256 << 10  # blocks from this size on are mapped on their own
KEPT_BYTES = 4 << 20  # free memory at the end of the heap that is kept for the next blocks


def return_large_blocks() -> None:
    """Return freed arrays at once.

    Left to itself, glibc raises the size from which a block is mapped on its own up to 32 MiB with every larger one
    that is freed. The next large arrays then lie in the heap, and where a small block follows one, its room stays with
    the process: a stage whose arrays grow and shrink holds up to twice what it needs.
    """
    _set(M_MMAP_THRESHOLD, LARGE_BYTES)
    _set(M_TRIM_THRESHOLD, KEPT_BYTES)


def share_one_heap() -> None:
    """Let all threads allocate in one heap, where some end and others begin all day.

    Else each gets another, up to eight for every core, and what one leaves behind there no other one uses.
    """
    _set(M_ARENA_MAX, 1)


def _set(parameter: int, value: int) -> None:
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").mallopt(parameter, value)


def release_memory() -> None:
    """Return what is free now, in pages between blocks too."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


class Release:
    """Memory that lies free is returned after every so many steps of what runs for hours.

    Without it, a process whose blocks come and go keeps a few MB more every hour, in steps.
    """

    def __init__(self, every: int) -> None:
        self._every, self._steps = every, 0

    def step(self) -> None:
        """At the end of a step, where a few milliseconds do not count."""
        self._steps += 1
        if self._steps % self._every == 0:
            release_memory()
