"""When the tracker applies map updates: the only decision that could depend on timing."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Protocol

from stereo_sfm.types import Applied


class Schedule(Protocol):
    """Decides, before each frame, how many updates are applied first."""

    def keyframe(self, frame_index: int) -> None:
        """The frame with this index (0, 1, 2, ... as tracked) became a keyframe: one more update will come."""
        ...

    def due(self, frame_index: int, frame_id: int) -> int | None:
        """How many updates to wait for before this frame; None: take those available without waiting."""
        ...


class Lockstep:
    """The update of a keyframe at frame f is applied just before frame f + lag, wherever and whenever computed."""

    def __init__(self, lag_frames: int) -> None:
        self._lag = max(lag_frames, 1)
        self._due: deque[int] = deque()

    def keyframe(self, frame_index: int) -> None:
        self._due.append(frame_index + self._lag)

    def due(self, frame_index: int, frame_id: int) -> int | None:
        count = 0
        while self._due and self._due[0] <= frame_index:
            self._due.popleft()
            count += 1
        return count


class Realtime:
    """The updates that the mapper has finished so far. `Applied` messages record the choice."""

    def keyframe(self, frame_index: int) -> None:
        pass

    def due(self, frame_index: int, frame_id: int) -> int | None:
        return None


class Recorded:
    """The choices of an earlier run, from its `Applied` messages."""

    def __init__(self, applied: Sequence[Applied]) -> None:
        self._due = deque(sorted(applied, key=lambda a: a.version))
        self._coming = 0  # one for each keyframe: a repeat that differs has none to wait for where the run had one

    def keyframe(self, frame_index: int) -> None:
        self._coming += 1

    def due(self, frame_index: int, frame_id: int) -> int | None:
        count = 0
        while self._due and count < self._coming and self._due[0].before_frame_id <= frame_id:
            self._due.popleft()
            count += 1
        self._coming -= count
        return count
