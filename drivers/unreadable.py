"""What of a source cannot be read: said one by one at first, then counted."""

from __future__ import annotations

import logging

log = logging.getLogger("stereo_sfm")

SHOWN_WARNINGS = 5  # one by one; then only their count


class Unreadable:
    """Frames, images or messages of one source that are skipped."""

    def __init__(self, name: str, what: str) -> None:
        """Args: name, of the source. what: how all together are called, as "images could not be read"."""
        self._name, self._what = name, what
        self._count = 0

    def begin(self) -> None:
        """Before a reading of its own count."""
        self._count = 0

    def skip(self, why: str) -> None:
        """Count one, and say so if there are few."""
        self._count += 1
        if self._count <= SHOWN_WARNINGS:
            log.warning("%s: %s", self._name, why)

    def end(self) -> None:
        """After the last one: their number, where not all were said."""
        if self._count > SHOWN_WARNINGS:
            log.warning("%s: %d %s", self._name, self._count, self._what)
