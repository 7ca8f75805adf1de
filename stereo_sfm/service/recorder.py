"""The recorder as a process of the service: it outlives pipelines, and they outlive it."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.log.provenance import Opening
from stereo_sfm.messages import Health, LogLine, SourceCounters
from stereo_sfm.pipeline.channels import DroppingOutbox
from stereo_sfm.pipeline.images import ImageLayout, ImageRing, SlotImage
from stereo_sfm.pipeline.interrupts import STOP_SIGNALS, ignored_by_children
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.pipeline.text import LOGGER, Listener, emit
from stereo_sfm.pipeline.threads import thread_environment
from stereo_sfm.pipeline.watchdog import Heartbeat, HeartbeatThread, Watchdog
from stereo_sfm.recording.quota import GB, Quota
from stereo_sfm.recording.recorder import THUMBNAIL_S, Policy, RecorderState, SegmentRecorder
from stereo_sfm.service.config import RecordingConfig
from stereo_sfm.types import Applied, Dropped, Frame, Keyframe, LoopResult, MapUpdate, Observations

log = logging.getLogger(LOGGER)

RECORDED = (
    Frame,
    Keyframe,
    MapUpdate,
    LoopResult,
    Applied,
    Dropped,
    Health,
    SourceCounters,
    LogLine,
)
WAITING = 20_000  # messages for the recorder, beyond which the oldest are lost
HELD = 6  # images that the recorder has not read yet
SILENT_S = 3.0
STATE_S = 0.5
CLOSE_S = 2.0


@dataclass(frozen=True, eq=False)
class Begin:
    """A session begins: another recording."""

    policy: Policy
    rig: Rig
    config: Config
    source: str
    opening: Opening
    ring: tuple[ImageLayout, int, str]  # layout, slots, name


@dataclass(frozen=True)
class Mark:
    """Keep what lies around now."""

    text: str


@dataclass(frozen=True)
class Finish:
    """The session is over."""


@dataclass(frozen=True)
class _Read:
    """An image was read: its slot is free."""

    number: int


def policy_of(config: RecordingConfig, mode: str) -> Policy:
    """The settings as the recorder takes them."""
    c = config
    quota = Quota(c.quota_gb * GB, c.quota_percent, c.min_free_gb * GB)
    return Policy(
        Path(c.folder), mode, c.image_format, 60 * c.segment_min, c.segment_mb * 1e6, quota, 60 * c.black_box_min,
        c.mark_before_s, c.mark_after_s,
    )  # fmt: skip


class Recorder:
    """The service's side: never blocks, starts the process again when it dies or hangs."""

    def __init__(self, config: RecordingConfig) -> None:
        self._config, self.mode = config, config.mode
        self._begin: Begin | None = None
        self._run: ProcessRun | None = None
        self._held: dict[int, tuple[ProcessRun, SlotImage]] = {}
        self._number = 0
        self._next_image_ns = 0
        self.state = RecorderState("", "", 0, 0, "")
        self._lock = threading.RLock()
        self._process: BaseProcess | None = None
        self._outbox: DroppingOutbox | None = None
        self._watchdog: Watchdog | None = None
        self._closing = False

    @property
    def pid(self) -> int | None:
        """Of the process, where there is one."""
        return None if self._process is None else self._process.pid

    def start(self) -> None:
        """Start the process before the first pipeline is up, so that no image is missed."""
        with self._lock:
            if self.mode != "off" and self._process is None:
                self._start_process()

    # -- sessions ----------------------------------------------------------------------------------------------------

    def begin(self, run: ProcessRun, config: Config, source: str, opening: Opening) -> None:
        """A pipeline is up."""
        with self._lock:
            self._run = run
            policy = policy_of(self._config, self.mode)
            self._begin = Begin(policy, run.info.rig, config, source, opening, run.ring)
            self._start_recording()

    def end(self) -> None:
        """The pipeline has ended."""
        with self._lock:
            self._begin = self._run = None
            self._send(Finish())
            self._held.clear()

    def set_mode(self, mode: str) -> None:
        """Record something else from now on."""
        with self._lock:
            self.mode = mode
            if self._begin is not None:
                self._begin = replace(self._begin, policy=policy_of(self._config, mode))
                self._start_recording()

    def change(self, config: RecordingConfig) -> None:
        """Other limits from now on."""
        with self._lock:
            self._config = config
            policy = policy_of(config, self.mode)
            if self._begin is not None:
                self._begin = replace(self._begin, policy=policy)
            self._send(policy)

    def _start_recording(self) -> None:
        if self.mode == "off":
            self._send(Finish())
            return
        if self._process is None:
            self._start_process()
        self._send(self._begin)

    # -- messages ----------------------------------------------------------------------------------------------------

    def image(self, message: SlotImage) -> bool:
        """An image of the running pipeline; True if its slot is returned later by the recorder."""
        with self._lock:
            if self._outbox is None or self._run is None or self.mode == "off":
                return False
            if self.mode == "lean" and message.image.stamp_ns < self._next_image_ns:
                return False
            if len(self._held) >= HELD:
                self._send(Dropped(message.image.frame_id, message.image.stamp_ns, "log", "the recorder is slow"))
                return False
            self._next_image_ns = message.image.stamp_ns + int(THUMBNAIL_S * 1e9)
            self._number += 1
            self._held[self._number] = (self._run, message)
            self._send((self._number, message))
            return True

    def put(self, message: object) -> None:
        """Any other message of the pipeline."""
        if self.mode == "off" or not isinstance(message, RECORDED):
            return
        if isinstance(message, Frame):
            message = replace(message, observations=Observations.empty())
        self._send(message)

    def mark(self, text: str) -> None:
        """Keep what lies around now."""
        self._send(Mark(text))

    def _send(self, message: object) -> None:
        outbox = self._outbox
        if outbox is not None:
            outbox.send(message)

    # -- the process -------------------------------------------------------------------------------------------------

    def _start_process(self) -> None:
        context = multiprocessing.get_context("spawn")
        (messages, send), (reports, to_main) = context.Pipe(False), context.Pipe(False)
        with ignored_by_children(), thread_environment(1):
            process = context.Process(target=run_recorder, args=(messages, to_main), name="recorder", daemon=True)
            process.start()
        messages.close()
        to_main.close()
        assert process.pid is not None
        self._process, self._outbox = process, DroppingOutbox(send, WAITING)
        self._watchdog = Watchdog({"recorder": process.pid}, log.warning, SILENT_S)
        threading.Thread(target=self._listen, args=(process, reports), name="recorder", daemon=True).start()

    def _listen(self, process: BaseProcess, reports: Connection) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                message = reports.recv()
                if self._watchdog is not None:
                    self._watchdog.received("recorder", message)
                self._take(message)
        reports.close()
        process.join()
        with self._lock:
            if self._process is not process:
                return
            for run, image in self._held.values():
                run.release(image)
            self._held.clear()
            self._process = self._outbox = self._watchdog = None
            if self._closing:
                return
            log.error("the recorder ended (exit code %s): a new recording begins", process.exitcode)
            if self._begin is not None:
                self._start_recording()

    def _take(self, message: object) -> None:
        if isinstance(message, _Read):
            with self._lock:
                held = self._held.pop(message.number, None)
            if held is not None:
                held[0].release(held[1])
        elif isinstance(message, RecorderState):
            self.state = message
        elif isinstance(message, LogLine):
            emit(message)

    def check(self) -> None:
        """Kill a process that hangs; call it regularly."""
        watchdog, process = self._watchdog, self._process
        if watchdog is not None and process is not None and watchdog.silent(["recorder"]):
            process.kill()

    def close(self) -> None:
        """Write everything, as far as the disk takes it in time."""
        with self._lock:
            self._closing = True
            process, outbox = self._process, self._outbox
        if outbox is not None:
            outbox.close()
        if process is not None:
            process.join(CLOSE_S + 0.5)
            if process.is_alive():
                log.warning("the recorder did not end in time: the last seconds may be missing")
                process.kill()
                process.join()


def run_recorder(messages: Connection, to_main: Connection) -> None:
    """Body of the process."""
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    lock = threading.Lock()

    def send(message: object) -> None:
        with lock, contextlib.suppress(OSError):
            to_main.send(message)

    logging.getLogger(LOGGER).setLevel(logging.INFO)
    body = _Body(send)
    with Listener("recorder", send), HeartbeatThread("recorder", lambda beat: body.beat(beat)):
        with contextlib.suppress(EOFError, OSError):
            while True:
                body.take(messages.recv())
        body.finish()
    os._exit(0)  # a thread may still wait for the disk


class _Body:
    """What the process does with each message."""

    def __init__(self, send: Callable[[object], None]) -> None:
        self._send = send
        self._recorder: SegmentRecorder | None = None
        self._ring: ImageRing | None = None
        self._next_state_s = 0.0
        self._problem = ""
        self._begin: Begin | None = None

    def take(self, message: object) -> None:
        """Any message from the service."""
        if isinstance(message, tuple):
            number, image = message  # pyright: ignore[reportUnknownVariableType]
            self._image(number, image)  # pyright: ignore[reportUnknownArgumentType]
        elif isinstance(message, Begin):
            self.finish()
            self._begin = message
            self._open(message)
        elif isinstance(message, Finish):
            self.finish()
        elif isinstance(message, Policy):
            if self._recorder is not None:
                self._recorder.change(message)
        elif isinstance(message, Mark):
            if self._recorder is not None:
                self._recorder.mark(message.text)
        elif self._recorder is not None:
            self._recorder.put(message)

    def _open(self, begin: Begin) -> None:
        layout, slots, name = begin.ring
        self._ring = ImageRing(layout, slots, name)
        try:
            self._recorder = SegmentRecorder(begin.policy, begin.rig, begin.config, begin.source, begin.opening)
            self._problem = ""
        except OSError as error:
            self._problem = f"cannot record to {begin.policy.root}: {error.strerror}"

    def _image(self, number: int, message: SlotImage) -> None:
        image = None
        if self._ring is not None and self._begin is not None:
            if self._recorder is None:
                self._open_again(self._begin)
            if self._recorder is not None:
                image = self._ring.read(message)
        self._send(_Read(number))
        if image is not None and self._recorder is not None:
            self._recorder.image(image)

    def _open_again(self, begin: Begin) -> None:
        """The folder could not be made: another attempt, once a second."""
        if time.monotonic() >= self._next_state_s:
            self._open(begin)

    def beat(self, beat: Heartbeat) -> None:
        """In the heartbeat's thread: a sign of life, and the state."""
        self._send(beat)
        if time.monotonic() >= self._next_state_s:
            self._next_state_s = time.monotonic() + STATE_S
            recorder = self._recorder
            state = RecorderState("", "", 0, 0, self._problem, bool(self._problem))
            self._send(state if recorder is None else recorder.state())

    def finish(self) -> None:
        """Close the recording."""
        recorder, self._recorder, self._begin = self._recorder, None, None
        if recorder is not None:
            recorder.close(CLOSE_S)
        if self._ring is not None:
            self._ring.close()
            self._ring = None
