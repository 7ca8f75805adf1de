"""Messages about a run for the log, the viewer and the output folder. Nothing is read back from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol


@dataclass(frozen=True)
class Topic:
    """A topic of the log; a message that has one declares it as `TOPIC`.

    Attributes:
        name: of the topic.
        when: when it is written.
        compare: whether `diff` compares it.
        sequence: the field of the message that is the frame id.
    """

    name: str
    when: str
    compare: bool = True
    sequence: str = "frame_id"


@dataclass(frozen=True)
class StageTimes:
    """Wall-clock milliseconds a frame spent in each stage; never compared by `diff`."""

    TOPIC: ClassVar[Topic] = Topic("/stage_times", "every frame: milliseconds in each stage", compare=False)

    frame_id: int
    ms: dict[str, float]


@dataclass(frozen=True)
class Health:
    """How one stage keeps up; wall clock, never compared."""

    TOPIC: ClassVar[Topic] = Topic("/health", "every second and stage: rate, queue, latency", compare=False)

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

    TOPIC: ClassVar[Topic] = Topic("/counters", "every few seconds: counters of a live camera", compare=False)

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
class SaveMap:
    """A request: write the session's part of the map."""

    folder: Path  # replaced


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
