"""The selected part of a source."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Selection:
    """Start time, duration, frame step and maximum number of frames; everything by default.

    Attributes:
        start_s: seconds after the first frame at which the part begins.
        duration_s: seconds that the part lasts.
        frame_skip: 1 passes every frame, 3 every third.
        max_frames: maximum number of frames.
    """

    start_s: float = 0.0
    duration_s: float = float("inf")
    frame_skip: int = 1
    max_frames: int | None = None


EVERYTHING = Selection()
