"""Messages about a run for the log, the viewer and the output folder. Nothing is read back from them."""

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
    """A human-readable line from the process of a stage."""

    stage: str
    level: str  # a name of `logging`
    text: str


@dataclass(frozen=True)
class SourceCounters:
    """Counters of a live camera (stereo_sfm.drivers.live.counters) up to a frame; never compared."""

    frame_id: int
    counts: dict[str, float]


@dataclass(frozen=True)
class Compiling:
    """A kernel is being compiled, once on this machine."""

    stage: str
    kernel: str


@dataclass(frozen=True)
class MapSaved:
    """The map of a run so far was written on request, or why it was not."""

    folder: str
    keyframes: int
    why: str = ""  # it was not written


@dataclass(frozen=True)
class Localized:
    """From this map update on poses are in the frame of the saved map that the run began with."""

    version: int


@dataclass(frozen=True)
class Relocalize:
    """A request: search the whole saved map for the camera."""


@dataclass(frozen=True)
class LogEnded:
    """The log has ended early; the run continues."""

    why: str


class Sink(Protocol):
    """Takes every message of a run in order: StereoImage, Frame, Keyframe, MapUpdate, LoopResult, StageTimes, ..."""

    def put(self, message: object) -> None: ...
