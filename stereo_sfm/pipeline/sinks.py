"""Where the messages of a run go besides the stages: the log, the viewer, the output folder. Nothing reads back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class StageTimes:
    """Wall-clock milliseconds a frame spent in each stage; never compared by `diff`."""

    frame_id: int
    ms: dict[str, float]


class Sink(Protocol):
    """Takes every message of a run in order: StereoImage, Frame, Keyframe, MapUpdate, LoopResult, StageTimes, ..."""

    def put(self, message: object) -> None: ...
