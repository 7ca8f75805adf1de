"""The bodies of the processes. Each worker gets its pipes; its last message is End or Failed."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import STAGES, Config
from stereo_sfm.drivers.choice import Opener
from stereo_sfm.errors import StereoSfmError, from_os_error
from stereo_sfm.log.provenance import Opening
from stereo_sfm.maps.folders import MapFolders, make_mapper, save_result
from stereo_sfm.messages import Compiling, Localized
from stereo_sfm.pipeline.channels import End, Failed, Inbox, Lost, Outbox
from stereo_sfm.pipeline.interrupts import STOP_SIGNALS
from stereo_sfm.pipeline.schedule import Lockstep, Realtime, Recorded, Schedule
from stereo_sfm.pipeline.text import LOGGER, Listener
from stereo_sfm.pipeline.watchdog import HeartbeatThread
from stereo_sfm.types import Applied, Keyframe, LoopResult, MapUpdate, Trajectory
from stereo_sfm.viz.server import LOOPBACK

UPSTREAM_LOST = 70  # exit code of a worker that ended because another one died


@dataclass(frozen=True, eq=False)
class Setup:
    """What every stage gets once the source is open."""

    rig: Rig
    config: Config
    ground_truth: Trajectory | None
    source_name: str
    ring_name: str
    applied: tuple[Applied, ...] | None  # a recorded schedule to repeat
    realtime: bool
    folders: MapFolders
    delays: int | None  # seed of random delays in every stage (tests)
    opening: Opening = field(default_factory=Opening)  # of the source


class Report(Outbox):
    """The messages of a worker to main, with its heartbeat."""

    def __init__(self, stage: str, connection: Connection) -> None:
        super().__init__(connection, 512)
        self.pulse = HeartbeatThread(stage, self.send)


def guarded(stage: str, body: Callable[..., None], report: Connection, *args: Any) -> None:
    """Entry of every worker process."""
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # main handles Ctrl-C
    to_main = Report(stage, report)
    logging.getLogger(LOGGER).setLevel(logging.INFO)  # main decides what is printed
    try:
        with Listener(stage, to_main.send), to_main.pulse:
            body(to_main, *args)
        to_main.send(End(stage))
        to_main.close()
    except Lost:
        sys.stdout.flush()
        os._exit(UPSTREAM_LOST)
    except StereoSfmError as error:
        to_main.send(Failed(stage, str(error), True, error.exit_code))
        to_main.close()
        os._exit(error.exit_code)
    except BaseException as error:
        known = from_os_error(error) if isinstance(error, OSError) else None
        failed = (
            Failed(stage, str(known), True, known.exit_code)
            if known
            else Failed(stage, traceback.format_exc(), False, 1)
        )
        to_main.send(failed)
        to_main.close()
        os._exit(failed.exit_code)


@dataclass(frozen=True)
class Ready:
    """The stage has loaded what it needs; a run begins when all are ready."""

    stage: str


def ready(stage: str, setup: Setup, to_main: Outbox) -> None:
    """Load the stage's code and send `Ready`."""
    from stereo_sfm.kernel_cache import listening
    from stereo_sfm.pipeline.warm_up import warm_up_stage

    with listening(lambda kernel: to_main.send(Compiling(stage, kernel))):
        warm_up_stage(stage, setup.config, setup.rig)
    to_main.send(Ready(stage))


def prepare(stage: str, setup: Setup) -> Callable[[], None]:
    """Threads and cores of this process; returns what injects a random delay (tests) or nothing."""
    import cv2
    from threadpoolctl import threadpool_limits

    cv2.setNumThreads(setup.config.pipeline.threads)
    threadpool_limits(setup.config.pipeline.threads)  # the environment said so for the first run of this program only
    cpus = setup.config.pipeline.cpus.get(stage)
    if cpus and hasattr(os, "sched_setaffinity"):
        try:
            os.sched_setaffinity(0, cpus)
        except OSError:
            raise StereoSfmError(f"configuration: pipeline.cpus.{stage} is {list(cpus)}: no such core here") from None
    if setup.delays is None:
        return lambda: None
    import numpy as np

    rng = np.random.default_rng([setup.delays, STAGES.index(stage)])
    return lambda: time.sleep(float(rng.exponential(0.01)) if rng.random() < 0.3 else 0.0)


def run_capture(
    to_main: Report,
    opener: Opener,
    control: Connection,
    tracker: Connection,
    readers: tuple[Connection, Connection],
) -> None:
    """Open the source, describe it to main, read it to the end."""
    from stereo_sfm.pipeline.capture import CaptureStage, FreeSlots, SourceInfo, StopFlag
    from stereo_sfm.pipeline.images import ImageLayout, ImageRing

    with opener() as source:
        to_main.send(SourceInfo(source.name, source.rig, source.ground_truth, source.frame_count, source.live))
        jpeg: bool
        setup, jpeg = Inbox[tuple[Setup, bool]](control).take()
        delay = prepare("capture", setup)
        slots = setup.config.pipeline.ring_slots
        ring = ImageRing(ImageLayout.of(source.rig), slots, setup.ring_name)
        word = Inbox[str](control).take()  # main sends go when every stage is ready, or stop
        to_tracker = Outbox(tracker)
        stage = CaptureStage(
            source,
            ring,
            FreeSlots(slots, *readers),
            to_tracker,
            to_main,
            to_main.pulse,
            StopFlag(control, word == "stop"),
            setup.realtime,
            jpeg,
        )
        delay()
        stage.run()
        ring.close()


def _schedule(setup: Setup) -> Schedule:
    if setup.applied is not None:
        return Recorded(setup.applied)
    return Realtime() if setup.realtime else Lockstep(setup.config.pipeline.update_lag_frames)


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
    to_loop: Connection,
) -> None:
    """Images to frames and keyframes."""
    from stereo_sfm.messages import StageTimes
    from stereo_sfm.pipeline.health import HealthMeter
    from stereo_sfm.pipeline.images import ImageLayout, ImageRing, SlotImage
    from stereo_sfm.pipeline.stages import TrackStage, make_tracker_with_places
    from stereo_sfm.timing import Spans

    setup = Inbox[Setup](control).take()
    delay = prepare("tracker", setup)
    spans = Spans()
    ring = ImageRing(ImageLayout.of(setup.rig), setup.config.pipeline.ring_slots, setup.ring_name)
    tracker = make_tracker_with_places(setup.config, setup.rig, spans, setup.ground_truth)
    stage = TrackStage(tracker, _schedule(setup), Inbox[MapUpdate](updates))
    inbox = Inbox[SlotImage | End](images)
    free, keyframes = Outbox(release), (Outbox(to_mapper), Outbox(to_loop))
    ready("tracker", setup, to_main)
    meter = HealthMeter("tracker", to_main.send)
    frame_id = -1
    while isinstance(message := _next_image(inbox), SlotImage):
        to_main.pulse.begin()
        image = ring.read(message)
        free.send(message.slot)
        delay()
        begin = time.monotonic()
        with spans.span("track"):
            answers = list(stage.step(image))
        for answer in answers:
            to_main.send(answer)
            if isinstance(answer, Keyframe):
                for outbox in keyframes:
                    outbox.send(answer)
        now = time.monotonic()
        frame_id = image.frame_id
        to_main.send(StageTimes(frame_id, {**spans.take(), "latency": (now - message.captured_s) * 1e3}))
        meter.add(frame_id, (now - begin) * 1e3, to_main.waiting())
        to_main.pulse.end()
    meter.report()
    for outbox in keyframes:
        outbox.send(End("tracker"))
        outbox.close()
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
    answers = Inbox[Any](results)
    saver = MapSaver(mapper, setup.config, to_main.send)
    ready("mapper", setup, to_main)
    meter = HealthMeter("mapper", to_main.send)
    frame_id, busy, found = -1, False, False
    while isinstance(keyframe := saver.next(inbox, control), Keyframe):
        to_main.pulse.begin()
        delay()
        begin = time.monotonic()
        if busy and mapper.job_due:
            mapper.finish_job(answers.take())
            busy = False
        update = stage.step(keyframe)
        saver.changed = True
        if mapper.found and not found:
            found = True
            to_main.send(Localized(update.version))
        to_main.send(update)
        to_tracker.send(update)
        if (job := mapper.pending_job()) is not None:
            if busy:
                answers.take()  # a newer loop made the result of this job obsolete
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
        mapper.finish_job(answers.take())
    last = stage.finish()
    if last is not None:
        to_main.send(last)
    save_result(mapper, setup.config, setup.folders)
    meter.report()
    to_tracker.close()
    to_optimizer.send(End("mapper"))
    to_optimizer.close()


def release_memory() -> None:
    """Return freed memory to the system, where the C library supports it (glibc)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


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


def run_loop(to_main: Report, control: Connection, keyframes: Connection, to_mapper: Connection) -> None:
    """Keyframes to loop results."""
    from stereo_sfm.messages import StageTimes
    from stereo_sfm.pipeline.health import HealthMeter
    from stereo_sfm.pipeline.stages import make_closer
    from stereo_sfm.timing import Spans

    setup = Inbox[Setup](control).take()
    delay = prepare("loop", setup)
    spans = Spans()
    closer = make_closer(setup.config, setup.rig, spans, setup.folders.localize_only)
    inbox, outbox = Inbox[Keyframe | End](keyframes), Outbox(to_mapper)
    ready("loop", setup, to_main)
    meter = HealthMeter("loop", to_main.send)
    frame_id = -1
    while isinstance(keyframe := inbox.take(), Keyframe):
        if closer is None:
            continue
        to_main.pulse.begin()
        delay()
        begin = time.monotonic()
        result = closer.step(keyframe)
        to_main.send(result)
        outbox.send(result)
        frame_id, ms = keyframe.frame_id, (time.monotonic() - begin) * 1e3
        to_main.send(StageTimes(frame_id, {**spans.take(), "loop": ms}))
        meter.add(frame_id, ms)
        to_main.pulse.end()
    meter.report()
    outbox.close()


@dataclass(frozen=True)
class LogOptions:
    """The file of a run's log and what it contains."""

    path: Path
    image_format: str = "png"  # png | raw | jpeg | none


@dataclass(frozen=True)
class ViewerOptions:
    """How a run is shown."""

    mode: str  # spawn | serve | save
    path: Path | None = None  # of mode "save"
    address: str = LOOPBACK  # of mode "serve"


def run_viewer(to_main: Report, control: Connection, messages: Connection, options: ViewerOptions) -> None:
    """Send the messages from main to rerun."""
    from stereo_sfm.viz.sink import RerunSink

    setup = Inbox[Setup](control).take()
    prepare("viewer", setup)
    sink = RerunSink(setup.rig, setup.source_name, options.mode, options.path, setup.ground_truth, options.address)
    inbox = Inbox[Any](messages)
    with contextlib.suppress(Lost):
        while not isinstance(message := inbox.take(), End):
            sink.put(message)
    sink.close()
