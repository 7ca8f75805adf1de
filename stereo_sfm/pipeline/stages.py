"""The stages as every wiring runs them: a `step` each, and where they wait for one another.

A stage only makes blocking reads of messages that must come, so what it computes depends on the input alone. Inline a
mailbox is a deque that is never empty when it is read; between processes it is the receiving end of a pipe.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Protocol, TypeVar

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.drivers.source import Source
from stereo_sfm.mapping.protocol import AnyMapper
from stereo_sfm.messages import SourceCounters
from stereo_sfm.pipeline.schedule import Schedule
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.factory import AnyTracker, make_tracker
from stereo_sfm.types import (
    Applied,
    Dropped,
    Frame,
    Keyframe,
    LoopResult,
    MapUpdate,
    StartCheck,
    StereoImage,
    Trajectory,
)

T_co = TypeVar("T_co", covariant=True)


class Mailbox(Protocol[T_co]):
    """Where a stage's awaited messages arrive, in order."""

    def take(self) -> T_co:
        """The next message; blocks until it is there."""
        ...

    def ready(self) -> bool:
        """Whether `take` would return at once: only the realtime schedule asks."""
        ...


class LocalMailbox(deque[T_co]):  # type: ignore[type-var]
    """A mailbox inside one process."""

    def take(self) -> T_co:
        return self.popleft()

    def ready(self) -> bool:
        return len(self) > 0


def sensor_drop(image: StereoImage) -> Dropped | None:
    """Images lost by the sensor or its driver just before an image."""
    if not image.dropped_before:
        return None
    first = image.frame_id - image.dropped_before
    return Dropped(first, image.stamp_ns, "sensor", "lost by the sensor or the driver", image.dropped_before)


def source_counters(source: Source, frame_id: int) -> SourceCounters | None:
    """Counters of a live source so far; None for files, which have none."""
    return SourceCounters(frame_id, dict(source.counters)) if source.counters else None


def start_check(source: Source) -> StartCheck | None:
    """What the source's first images said about its calibration; None for one that was not asked, or that fits."""
    return getattr(source, "start_check", None)


class AnyCloser(Protocol):
    """Computes the loop results of keyframes."""

    def step(self, keyframe: Keyframe) -> LoopResult: ...

    def resume(self, keyframes: Sequence[Keyframe], loops: Sequence[LoopResult]) -> None:
        """Go on after another process, which ended at the last of its keyframes or after it, with what it knew."""
        ...


class TrackStage:
    """Images in; `Applied`, `Frame` and `Keyframe` messages out."""

    def __init__(self, tracker: AnyTracker, schedule: Schedule, updates: Mailbox[MapUpdate]) -> None:
        self._tracker, self._schedule, self._updates = tracker, schedule, updates
        self._index = 0

    def step(self, image: StereoImage) -> Iterator[Applied | Frame | Keyframe]:
        """Apply the updates that are due, then track; the keyframe is described after its frame was taken."""
        for update in self._take(self._schedule.due(self._index, image.frame_id)):
            self._tracker.apply(update)
            yield Applied(update.version, image.frame_id, image.stamp_ns)
        frame, keyframe = self._tracker.step(image)
        if keyframe is not None:
            self._schedule.keyframe(self._index)
        self._index += 1
        yield frame
        if keyframe is not None:
            yield self._tracker.describe(keyframe)

    def _take(self, count: int | None) -> Iterator[MapUpdate]:
        if count is None:
            while self._updates.ready():
                yield self._updates.take()
        else:
            for _ in range(count):
                yield self._updates.take()


class MapStage:
    """Keyframes in, one `MapUpdate` each out; the loop result of a keyframe is taken `lag` keyframes later."""

    def __init__(self, mapper: AnyMapper, lag: int, loops: Mailbox[LoopResult] | None) -> None:
        self.mapper = mapper
        self._lag, self._loops = max(lag, 0), loops
        self._taken = self._count = 0

    def step(self, keyframe: Keyframe) -> MapUpdate:
        """The loop result of one keyframe."""
        loop = None
        if self._loops is not None and self._count >= self._lag:
            loop = self._loops.take()
            self._taken += 1
        self._count += 1
        return self.mapper.step(keyframe, loop)

    def finish(self) -> MapUpdate | None:
        """After the last keyframe: loops that were not taken yet, and what was going on in the background."""
        if self._count == 0:
            return None
        loops = [self._loops.take() for _ in range(self._count - self._taken)] if self._loops is not None else []
        return self.mapper.finish(loops)


def make_tracker_with_places(
    config: Config, rig: Rig, spans: NoSpans | None = None, ground_truth: Trajectory | None = None
) -> AnyTracker:
    """The tracker that the configuration names; one that is lost searches its newest keyframes."""
    if not rig.stereo:
        return make_tracker(config, rig, spans, ground_truth)
    from stereo_sfm.loop.recent_places import RecentPlaces

    return make_tracker(config, rig, spans, ground_truth, RecentPlaces(config.loop, rig))


def make_closer(
    config: Config, rig: Rig, spans: NoSpans | None = None, localize_only: bool = False
) -> AnyCloser | None:
    """The loop closer, which goes on after errors, or None where there is none."""
    if not config.closes_loops(rig.stereo, localize_only):
        return None
    from stereo_sfm.loop.closer import LoopCloser
    from stereo_sfm.loop.vocabulary_file import configured_vocabulary
    from stereo_sfm.pipeline.restarting_closer import RestartingCloser

    return RestartingCloser(lambda: LoopCloser(config.loop, rig, configured_vocabulary(config.loop), spans))
