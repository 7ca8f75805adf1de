"""The recorder as a process of the service: it survives the death of a pipeline, and a pipeline survives its death."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from stereo_sfm.config import Config
from stereo_sfm.log.provenance import Opening
from stereo_sfm.messages import Health, LogLine, SourceCounters
from stereo_sfm.pipeline.channels import DroppingOutbox
from stereo_sfm.pipeline.images import SlotImage
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.pipeline.text import LOGGER, emit
from stereo_sfm.recording.quota import GB, Quota
from stereo_sfm.recording.segment_recorder import THUMBNAIL_S, Policy, RecorderState
from stereo_sfm.service.child import follow, pipe, start_child
from stereo_sfm.service.config import RecordingConfig
from stereo_sfm.service.link import FIRST_PAUSE_S, LONGEST_PAUSE_S, STABLE_S
from stereo_sfm.service.recorder_process import CLOSE_S, Begin, Finish, Mark, Read, run_recorder
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


def policy_of(config: RecordingConfig, mode: str) -> Policy:
    """The recorder's policy, from the settings."""
    c = config
    quota = Quota(c.quota_gb * GB, c.quota_percent, c.min_free_gb * GB, bool(c.upload), mode == "black_box")
    return Policy(
        Path(c.folder), mode, c.image_format, 60 * c.segment_min, c.segment_mb * 1e6, quota, 60 * c.black_box_min,
        c.mark_before_s, c.mark_after_s, c.upload, c.upload_mbit * 1e6 / 8,
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
        self._listener: threading.Thread | None = None  # the only one that waits for the process's end
        self._outbox: DroppingOutbox | None = None
        self._closing = False
        self._over = threading.Event()
        self._started_s = self._pause_s = 0.0  # when the process was started; before it is started again

    @property
    def pid(self) -> int | None:
        """Of the process, where there is one."""
        process = self._process  # which another thread may set to None
        return None if process is None else process.pid

    def start(self) -> None:
        """Start the process before the first pipeline is up, so that no image is missed."""
        with self._lock:
            if self.mode != "off" and self._process is None:
                self._start_process()

    # -- sessions ----------------------------------------------------------------------------------------------------

    def begin(self, run: ProcessRun, config: Config, source: str, opening: Opening) -> None:
        """A pipeline is up."""
        with self._lock:
            self._run, self._next_image_ns = run, 0  # another camera's time may begin anew
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
        if self._closing:
            return
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
            if not message.logged or len(self._held) >= HELD:
                self._send(message.image)
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
        """Keep the recording around this moment."""
        self._send(Mark(text))

    def _send(self, message: object) -> None:
        outbox = self._outbox
        if outbox is not None:
            outbox.send(message)

    # -- the process -------------------------------------------------------------------------------------------------

    def _start_process(self) -> None:
        (messages, send), (reports, to_main) = pipe(), pipe()
        process = start_child("recorder", run_recorder, messages, to_main)
        self._process, self._outbox, self._started_s = process, DroppingOutbox(send, WAITING), time.monotonic()
        self._listener = threading.Thread(target=self._listen, args=(process, reports), name="recorder", daemon=True)
        self._listener.start()

    def _listen(self, process: BaseProcess, reports: Connection) -> None:
        follow("recorder", process, reports, self._take)
        reports.close()
        process.join()
        with self._lock:
            if self._process is not process:
                return
            for run, image in self._held.values():
                run.release(image)
            self._held.clear()
            if self._outbox is not None:
                self._outbox.close()
            self._process = self._outbox = None
            if self._closing:
                return
            lived = time.monotonic() - self._started_s
            self._pause_s = 0.0 if lived > STABLE_S else min(max(2 * self._pause_s, FIRST_PAUSE_S), LONGEST_PAUSE_S)
            when = "now" if self._pause_s == 0.0 else f"in {self._pause_s:.0f} s"
            log.error("the recorder ended (exit code %s): a new recording begins %s", process.exitcode, when)
        if self._over.wait(self._pause_s):
            return
        with self._lock:
            if self._process is None and self._begin is not None:
                self._start_recording()

    def _take(self, message: object) -> None:
        if isinstance(message, Read):
            with self._lock:
                held = self._held.pop(message.number, None)
            if held is not None:
                held[0].release(held[1])
        elif isinstance(message, RecorderState):
            self.state = message
        elif isinstance(message, LogLine):
            emit(message)

    def close(self) -> None:
        """Write everything that the disk takes in time."""
        with self._lock:
            self._closing = True
            self._over.set()
            process, listener, outbox = self._process, self._listener, self._outbox
        if outbox is not None:
            outbox.close()
        if process is not None and listener is not None:
            if self.state.recording or self._number:  # else there is nothing to write
                listener.join(CLOSE_S + 0.5)
            if listener.is_alive():
                if self.state.recording:
                    log.warning("the recorder did not end in time: the last seconds may be missing")
                process.kill()
                listener.join()
