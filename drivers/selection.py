"""Which part of a source is wanted."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Selection:
    """From a time on, for a time, every k-th frame, at most so many; everything by default.

    Attributes:
        start_s: seconds after the first frame at which the part begins.
        duration_s: seconds that the part lasts.
        frame_skip: 1 passes every frame, 3 every third.
        max_frames: how many frames are passed at most.
    """

    start_s: float = 0.0
    duration_s: float = float("inf")
    frame_skip: int = 1
    max_frames: int | None = None


EVERYTHING = Selection()
