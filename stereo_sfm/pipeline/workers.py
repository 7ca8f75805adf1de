"""The bodies of the stages' processes. Each gets its pipes; its last message is End or Failed."""

from __future__ import annotations

import contextlib
import importlib
import pickle
import sys
import time
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from stereo_sfm.drivers.choice import Opener
from stereo_sfm.maps.folders import make_mapper, save_result
from stereo_sfm.messages import Localized
from stereo_sfm.pipeline.allocator import Release, release_memory
from stereo_sfm.pipeline.channels import End, Inbox, Lost, Outbox, PrefetchingInbox, pickled
from stereo_sfm.pipeline.child import Report, Setup, WarmUp, prepare, ready
from stereo_sfm.pipeline.loop_link import Known
from stereo_sfm.pipeline.schedule import Lockstep, Realtime, Recorded, Schedule
from stereo_sfm.types import Frame, Keyframe, LoopResult, MapUpdate

if TYPE_CHECKING:
    from stereo_sfm.timing import Spans
    from stereo_sfm.tracking.protocol import AnyTracker

RELEASE_KEYFRAMES = 20  # after which the loop closer returns what is free between its blocks, in 1.4 ms
RELEASE_IMAGES = 6000  # after which the tracker does


def run_capture(
    to_main: Report,
    control: Connection,
    opener: Opener | None,
    tracker: Connection,
    readers: tuple[Connection, ...],
    depth: Connection | None,
) -> None:
    """Open the source, describe it to main, read it to the end.

    Args:
        opener: of the source; None: main sends it.
        readers: where slots return: from the tracker, the log, and live depth if there is one. depth: to that one.
    """
    from stereo_sfm.pipeline.capture import CaptureStage, FreeSlots, SourceInfo, StopFlag
    from stereo_sfm.pipeline.depth_stage import depth_schedule
    from stereo_sfm.pipeline.images import ImageLayout, ImageRing

    opener = _opener(control) if opener is None else opener
    before = set(sys.modules)
    with opener() as source:
        to_main.send(SourceInfo.of(source, before))
        jpeg: bool
        setup, jpeg = Inbox[tuple[Setup, bool]](control).take()
        delay = prepare("capture", setup)
        slots = setup.config.pipeline.ring_slots
        ring = ImageRing(ImageLayout.of(source.rig), slots, setup.ring_name)
        first = Inbox[str](control).take()  # main sends go when every stage is ready, or stop
        to_tracker = Outbox(tracker)
        stage = CaptureStage(
            source,
            ring,
            FreeSlots(slots, *readers),
            to_tracker,
            to_main,
            to_main.pulse,
            StopFlag(control, first == "stop"),
            setup.realtime,
            jpeg,
            None if depth is None else Outbox(depth),
            depth_schedule(setup.config, setup.rig, setup.depth_frames),
        )
        delay()
        stage.run()
        ring.close()


def _opener(control: Connection) -> Opener:
    """Of the source, and its code before it comes."""
    inbox = Inbox[Opener | WarmUp](control)
    while isinstance(message := inbox.take(), WarmUp):
        for name in message.modules:
            with contextlib.suppress(ImportError):
                importlib.import_module(name)
    return message


def _schedule(setup: Setup) -> Schedule:
    if setup.applied is not None:
        return Recorded(setup.applied)
    return Realtime() if setup.realtime else Lockstep(setup.config.pipeline.update_lag_frames)


def _warmed_up(control: Inbox[Setup | WarmUp], spans: Spans) -> tuple[Setup, bool, AnyTracker | None]:
    """The set-up of the tracker, whether its code was loaded before it came, and the tracker where that was made."""
    from stereo_sfm.pipeline.stages import make_tracker_with_places

    expected: tuple[bytes, AnyTracker] | None = None
    while isinstance(message := control.take(), WarmUp):
        from stereo_sfm.pipeline.warm_up import warm_up_stage

        warm_up_stage("tracker", message.config, message.rig)
        made = make_tracker_with_places(message.config, message.rig, spans)
        expected = pickle.dumps((message.config, message.rig)), made
    if expected is None:
        return message, False, None
    same = message.ground_truth is None and pickle.dumps((message.config, message.rig)) == expected[0]
    return message, True, expected[1] if same else None


def _next_image(inbox: Inbox[Any]) -> Any:
    """If capture was killed, what it read so far is processed."""
    try:
        return inbox.take()
    except Lost:
        return End("capture")


def run_tracker(
    to_main: Report,
    control: Connection,
    images: Connection,
    release: Connection,
    updates: Connection,
    to_mapper: Connection,
) -> None:
    """Images to frames and keyframes."""
    from stereo_sfm.messages import StageTimes
    from stereo_sfm.pipeline.health import HealthMeter
    from stereo_sfm.pipeline.images import ImageLayout, ImageRing, SlotImage
    from stereo_sfm.pipeline.stages import TrackStage, make_tracker_with_places
    from stereo_sfm.timing import Spans

    spans = Spans()
    setup, warm, made = _warmed_up(Inbox[Setup | WarmUp](control), spans)
    delay = prepare("tracker", setup)
    ring = ImageRing(ImageLayout.of(setup.rig), setup.config.pipeline.ring_slots, setup.ring_name)
    if made is None:
        made = make_tracker_with_places(setup.config, setup.rig, spans, setup.ground_truth)
    stage = TrackStage(made, _schedule(setup), PrefetchingInbox[MapUpdate](updates))
    inbox = Inbox[SlotImage | End](images)
    free, keyframes = Outbox(release), Outbox(to_mapper)
    ready("tracker", setup, to_main, warm=warm)
    meter, tidy = HealthMeter("tracker", to_main.send), Release(RELEASE_IMAGES)
    frame_id = -1
    while isinstance(message := _next_image(inbox), SlotImage):
        to_main.pulse.begin()
        image = ring.read(message)
        free.send(message.slot)
        delay()
        begin = time.monotonic()
        answered = begin
        with spans.span("track"):
            for output in stage.step(image):
                data = pickled(output)
                to_main.send(data)
                if isinstance(output, Frame):
                    answered = time.monotonic()
                if isinstance(output, Keyframe):
                    keyframes.send(data)
        frame_id = image.frame_id
        to_main.send(StageTimes(frame_id, {**spans.take(), "latency": (answered - message.captured_s) * 1e3}))
        meter.add(frame_id, (time.monotonic() - begin) * 1e3, to_main.waiting())
        tidy.step()
        to_main.pulse.end()
    meter.report()
    keyframes.send(End("tracker"))
    keyframes.close()
    ring.close()


def run_mapper(
    to_main: Report,
    control: Connection,
    keyframes: Connection,
    loops: Connection,
    updates: Connection,
    jobs: Connection,
    results: Connection,
) -> None:
    """Keyframes to map updates."""
    from stereo_sfm.messages import StageTimes
    from stereo_sfm.pipeline.health import HealthMeter
    from stereo_sfm.pipeline.map_saver import MapSaver
    from stereo_sfm.pipeline.stages import MapStage
    from stereo_sfm.timing import Spans

    setup = Inbox[Setup](control).take()
    delay = prepare("mapper", setup)
    spans = Spans()
    mapper = make_mapper(setup.config, setup.rig, spans, setup.folders)
    closing = setup.config.closes_loops(setup.rig.stereo, setup.folders.localize_only)
    lag = setup.config.pipeline.loop_lag_keyframes
    stage = MapStage(mapper, lag, Inbox[LoopResult](loops) if closing else None)
    inbox = Inbox[Keyframe | End](keyframes)
    to_tracker, to_optimizer = Outbox(updates), Outbox(jobs)
    finished_jobs = Inbox[Any](results)
    saver = MapSaver(mapper, setup.config, to_main.send)
    ready("mapper", setup, to_main, lambda: _load_optimizer(setup, to_optimizer, finished_jobs))
    meter = HealthMeter("mapper", to_main.send)
    frame_id, busy, found = -1, False, False
    while isinstance(keyframe := saver.next(inbox, control), Keyframe):
        to_main.pulse.begin()
        delay()
        begin = time.monotonic()
        if busy and mapper.job_due:
            mapper.finish_job(finished_jobs.take())
            busy = False
        update = stage.step(keyframe)
        saver.changed = True
        if mapper.found and not found:
            found = True
            to_main.send(Localized(update.version))
        data = pickled(update)
        to_main.send(data)
        to_tracker.send(data)
        if (job := mapper.pending_job()) is not None:
            if busy:
                finished_jobs.take()  # a newer loop made the result of this job obsolete
            to_optimizer.send(job)
            busy = True
        frame_id = keyframe.frame_id
        ms = (time.monotonic() - begin) * 1e3
        to_main.send(StageTimes(frame_id, {**spans.take(), "map": ms}))
        meter.add(frame_id, ms)
        to_main.pulse.end()
    to_main.pulse.begin()
    saver.finish(setup.folders.session)
    if busy:
        mapper.finish_job(finished_jobs.take())
    last = stage.finish()
    if last is not None:
        to_main.send(last)
    save_result(mapper, setup.config, setup.folders)
    meter.report()
    to_tracker.close()
    to_optimizer.send(End("mapper"))
    to_optimizer.close()


def _load_optimizer(setup: Setup, jobs: Outbox, results: Inbox[Any]) -> None:
    """Let the optimizer load its code, once what a first run has to compile is compiled."""
    from stereo_sfm.pipeline.warm_up import scratch_job

    job = scratch_job(setup.config, setup.rig)
    if job is not None:
        jobs.send(job)
        results.take()


def run_optimizer(to_main: Report, control: Connection, jobs: Connection, results: Connection) -> None:
    """Full bundle adjustment in parallel with the mapper."""
    from stereo_sfm.mapping.mapper import Job, run_job

    setup = Inbox[Setup](control).take()
    delay = prepare("optimizer", setup)
    inbox, outbox = Inbox[Job | End](jobs), Outbox(results)
    while isinstance(job := inbox.take(), Job):
        to_main.pulse.begin()
        delay()
        outbox.send(run_job(job))
        del job
        release_memory()
        to_main.pulse.end()
    outbox.close()


def run_loop(to_main: Report, control: Connection, keyframes: Connection) -> None:
    """Keyframes to loop results; main passes both on (`pipeline.loop_link`)."""
    from stereo_sfm.messages import StageTimes
    from stereo_sfm.pipeline.health import HealthMeter
    from stereo_sfm.pipeline.stages import make_closer
    from stereo_sfm.timing import Spans

    setup = Inbox[Setup](control).take()
    delay = prepare("loop", setup)
    spans = Spans()
    closer = make_closer(setup.config, setup.rig, spans, setup.folders.localize_only)
    inbox = Inbox[Known | Keyframe | End](keyframes)
    ready("loop", setup, to_main)
    meter, tidy = HealthMeter("loop", to_main.send), Release(RELEASE_KEYFRAMES)
    frame_id = -1
    while not isinstance(keyframe := inbox.take(), End):
        if closer is None:
            continue
        to_main.pulse.begin()
        if isinstance(keyframe, Known):
            closer.resume([pickle.loads(data) for data in keyframe.keyframes], keyframe.loops)
            to_main.pulse.end()
            continue
        delay()
        begin = time.monotonic()
        to_main.send(closer.step(keyframe))
        frame_id, ms = keyframe.frame_id, (time.monotonic() - begin) * 1e3
        to_main.send(StageTimes(frame_id, {**spans.take(), "loop": ms}))
        meter.add(frame_id, ms)
        tidy.step()
        to_main.pulse.end()
    meter.report()
