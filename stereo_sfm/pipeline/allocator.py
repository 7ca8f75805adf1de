"""Memory that a process frees goes back to the system, where the C library is glibc."""

from __future__ import annotations

import contextlib
import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h
LARGE_BYTES = 256 << 10  # blocks from this size on are mapped on their own
KEPT_BYTES = 4 << 20  # free memory at the end of the heap that is kept for the next blocks


def return_large_blocks() -> None:
    """Return freed arrays at once.

    Left to itself, glibc raises the size from which a block is mapped on its own up to 32 MiB with every larger one
    that is freed. The next large arrays then lie in the heap, and where a small block follows one, its room stays with
    the process: a stage whose arrays grow and shrink holds up to twice what it needs.
    """
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(M_MMAP_THRESHOLD, LARGE_BYTES)
        libc.mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)


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
