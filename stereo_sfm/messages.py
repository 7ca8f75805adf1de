"""Where the messages of a run go besides the stages: the log, the viewer, the output folder. Nothing reads back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class StageTimes:
    """Wall-clock milliseconds a frame spent in each stage; never compared by `diff`."""

    frame_id: int
    ms: dict[str, float]


@dataclass(frozen=True)
class Health:
    """How one stage keeps up; wall clock, never compared."""

    stage: str
    frame_id: int
    rate: float  # per second
    queue: int  # messages waiting
    p50_ms: float
    p95_ms: float
    p99_ms: float
    dropped: int


@dataclass(frozen=True)
class LogLine:
    """A line for people, from the process of some stage."""

    stage: str
    level: str  # a name of `logging`
    text: str


@dataclass(frozen=True)
class SourceCounters:
    """What a live camera counts about itself (stereo_sfm.drivers.live.counters), up to a frame; never compared."""

    frame_id: int
    counts: dict[str, float]


@dataclass(frozen=True)
class Compiling:
    """A kernel is compiled, once on this machine; for people who wait."""

    stage: str
    kernel: str


@dataclass(frozen=True)
class LogEnded:
    """The log takes no more; the run goes on."""

    why: str


class Sink(Protocol):
    """Takes every message of a run in order: StereoImage, Frame, Keyframe, MapUpdate, LoopResult, StageTimes, ..."""

    def put(self, message: object) -> None: ...
