"""Memory that a process frees goes back to the system, where the C library is glibc."""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import pickle
from typing import TypeVar

T = TypeVar("T")

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # malloc.h
LARGE_BYTES = 256 << 10  # blocks from this size on are mapped on their own
ALIGNED = 16  # bytes, as malloc aligns
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


def share_one_heap() -> None:
    """Let all threads allocate in one heap, where some end and others begin all day.

    Else each gets another, up to eight for every core, and what one leaves behind there no other one uses.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").mallopt(M_ARENA_MAX, 1)


def release_memory() -> None:
    """Return what is free now, in pages between blocks too."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def in_own_pages(message: T) -> T:
    """The same message, with all its arrays in one mapping of their own.

    For what is kept long among much that comes and goes: its arrays leave the heap as one, whatever lies between them.
    """
    found: list[pickle.PickleBuffer] = []
    rest = pickle.dumps(message, protocol=5, buffer_callback=found.append)
    arrays = [array.raw() for array in found]
    starts = [0]
    for array in arrays:
        starts.append(starts[-1] + -(-array.nbytes // ALIGNED) * ALIGNED)
    room = memoryview(mmap.mmap(-1, max(starts[-1], 1), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS))
    places = [room[start : start + array.nbytes] for start, array in zip(starts, arrays, strict=False)]
    for place, array in zip(places, arrays, strict=True):
        place[:] = array
    return pickle.loads(rest, buffers=[place.toreadonly() for place in places])


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
