"""The reference: every stage in this process, one frame at a time. Other wirings give the same bits."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Generator, Sequence

from stereo_sfm.config import Config
from stereo_sfm.drivers.ascending import ascending
from stereo_sfm.drivers.checked_samples import checked_samples
from stereo_sfm.drivers.source import Source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps.folders import MapFolders, make_mapper, save_result
from stereo_sfm.messages import LogLine, Sink, StageTimes
from stereo_sfm.pipeline.depth_stage import depth_schedule, make_depth
from stereo_sfm.pipeline.schedule import Lockstep, Schedule
from stereo_sfm.pipeline.stages import (
    LocalMailbox,
    MapStage,
    TrackStage,
    make_closer,
    make_tracker_with_places,
    sensor_drop,
    source_counters,
    start_check,
)
from stereo_sfm.pipeline.text import Listener
from stereo_sfm.pipeline.threads import limited_threads
from stereo_sfm.timing import Spans
from stereo_sfm.types import Frame, Keyframe, LoopResult, MapUpdate, StereoImage

log = logging.getLogger("stereo_sfm")


class InlineRun:
    """All stages of one run; `step` takes one image through all of them."""

    def __init__(
        self,
        source: Source,
        config: Config,
        sinks: Sequence[Sink] = (),
        schedule: Schedule | None = None,
        folders: MapFolders | None = None,
        jpeg: bool = False,
        depth_frames: frozenset[int] | None = None,
    ) -> None:
        self._config, self._rig, self._folders = config, source.rig, folders or MapFolders()
        self._lines: deque[LogLine] = deque()
        self._jpeg, self._source, self._last = jpeg, source, -1
        self._spans = Spans()
        self._sinks = sinks
        self._updates: LocalMailbox[MapUpdate] = LocalMailbox()
        self._loops: LocalMailbox[LoopResult] = LocalMailbox()
        tracker = make_tracker_with_places(config, source.rig, self._spans, source.ground_truth)
        schedule = schedule or Lockstep(config.pipeline.update_lag_frames)
        self._track = TrackStage(tracker, schedule, self._updates)
        self._closer = make_closer(config, source.rig, self._spans, self._folders.localize_only)
        self._depth = make_depth(config, source.rig)
        self._depth_schedule = depth_schedule(config, source.rig, depth_frames)
        lag = config.pipeline.loop_lag_keyframes
        self.map_stage = MapStage(
            make_mapper(config, source.rig, self._spans, self._folders),
            lag,
            None if self._closer is None else self._loops,
        )

    def step(self, image: StereoImage) -> Frame:
        """Track one image; map and close loops when it becomes a keyframe."""
        self._last = image.frame_id
        drop = sensor_drop(image)
        if drop is not None:
            self.publish(drop)
        if self._jpeg:
            from stereo_sfm.log.images import encode_pair

            logged = encode_pair(image, "jpeg")
            image = logged.image
            self.publish(logged)
        else:
            self.publish(image)
        frame: Frame | None = None
        keyframe: Keyframe | None = None
        with self._spans.span("track"):
            for message in self._track.step(image):
                self.publish(message)
                frame = message if isinstance(message, Frame) else frame
                keyframe = message if isinstance(message, Keyframe) else keyframe
        assert frame is not None
        if keyframe is not None:
            self._map(keyframe)
        self._make_depth(image)
        self.publish(StageTimes(frame.frame_id, self._spans.take()))
        return frame

    def _make_depth(self, image: StereoImage) -> None:
        if self._depth is None or self._depth_schedule is None or not self._depth_schedule.due(image):
            return
        self._depth_schedule.taken(image)
        with self._spans.span("depth"):
            found = self._depth.step(image)
        if found is not None:
            self.publish(found)

    def _map(self, keyframe: Keyframe) -> None:
        if self._closer is not None:
            with self._spans.span("loop"):
                result = self._closer.step(keyframe)
            self.publish(result)
            self._loops.append(result)
        with self._spans.span("map"):
            update = self.map_stage.step(keyframe)
        self.publish(update)
        self._updates.append(update)

    def finish(self) -> None:
        """Finish the pending work after the last image."""
        update = self.map_stage.finish()
        if update is not None:
            self.publish(update)
        counters = source_counters(self._source, self._last)
        if counters is not None:
            self.publish(counters)
        save_result(self.map_stage.mapper, self._config, self._folders)

    def add_line(self, line: LogLine) -> None:
        """Take a line from any thread; the sinks get it with the next frame."""
        self._lines.append(line)

    def publish(self, message: object) -> None:
        """Send a message to every sink, after the waiting lines."""
        while self._lines:
            self._pass_on(self._lines.popleft())
        self._pass_on(message)

    def _pass_on(self, message: object) -> None:
        for sink in self._sinks:
            sink.put(message)


def run_inline(
    source: Source,
    config: Config,
    sinks: Sequence[Sink] = (),
    schedule: Schedule | None = None,
    folders: MapFolders | None = None,
    jpeg: bool = False,
    depth_frames: frozenset[int] | None = None,
) -> Generator[Frame, None, None]:
    """Take every image of an open source through all stages and yield its frame.

    Args:
        source: an open source. config: what decides the result.
        sinks: every message of the run goes to each, in order.
        schedule: when updates reach the tracker; lockstep when omitted.
        folders: maps to load and to save.
        jpeg: the sinks store images as JPEG, so the tracker gets the decoded pixels.
        depth_frames: the images with a live depth of a run that is repeated; None: by the configured rate.
    """
    run = InlineRun(source, config, sinks, schedule, folders, jpeg, depth_frames)
    with Listener("main", run.add_line), limited_threads(config.pipeline.threads):
        images, failure = checked_samples(ascending(source, source.name)), None
        checked = start_check(source)
        if checked is not None:
            run.publish(checked)
        while True:
            try:
                image = next(images)
            except StopIteration:
                break
            except (Exception, KeyboardInterrupt) as error:  # what was read so far is kept
                failure = error
                break
            frame = run.step(image)
            try:
                yield frame
            except GeneratorExit:  # the caller stopped iterating
                run.finish()
                raise
        try:
            run.finish()
        except StereoSfmError as error:
            if failure is None:
                raise
            log.warning("%s", error)
        if failure is not None:
            raise failure
