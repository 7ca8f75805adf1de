"""The stages as processes: the hub starts them, forwards their messages, and ends the run in order.

Connections: capture -> tracker (images by slot), tracker -> mapper and loop (keyframes), loop -> mapper (loop
results), mapper -> tracker (updates), mapper <-> optimizer (full bundle adjustment), every stage -> main, main ->
logger and viewer. Every arrow is a pipe of its own, so a killed process leaves no lock behind, and its death is an end
of file to its readers.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import resource
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import Opener
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps.folders import MapFolders
from stereo_sfm.messages import Compiling, Localized, LogEnded, LogLine, MapSaved, Relocalize, Sink
from stereo_sfm.pipeline import logger, workers
from stereo_sfm.pipeline.capture import SourceInfo
from stereo_sfm.pipeline.channels import DroppingOutbox, End, Failed, Outbox
from stereo_sfm.pipeline.images import ImageLayout, ImageRing, SlotImage
from stereo_sfm.pipeline.interrupts import ignored_by_children
from stereo_sfm.pipeline.text import Listener, emit
from stereo_sfm.pipeline.threads import thread_environment
from stereo_sfm.pipeline.watchdog import Heartbeat, Watchdog
from stereo_sfm.pipeline.workers import LogOptions, Ready, Setup, ViewerOptions
from stereo_sfm.types import Applied, Dropped, Frame, StereoImage

log = logging.getLogger("stereo_sfm")

SINKS = ("logger", "viewer")
PICTURE_NS = 100_000_000  # shortest interval between pictures for the viewer
CHECK_S = 0.25  # between two checks for processes that do not respond
GRACE_S = 1.2  # time for the logger to close its file after another stage died
STOP_GRACE_S = 2.0  # time for capture to react to a stop
END_S = 3.0  # time for a live run to end after a stop; for others, the longest time without a message
EXIT_S = 1.0  # time for the processes to exit after their last messages
VIEWER_GRACE_S = 10.0  # time for the viewer to show waiting messages after the run
BACKLOG = 20_000  # messages waiting for the logger in real time, beyond which the log is given up
MIN_OPEN_FILES = 128  # per process


class StageDied(StereoSfmError):
    """A process of the pipeline ended by an error that is not the user's, or was killed."""

    exit_code = 1


class ProcessRun:
    """One run over processes. Use as a context manager; iterate for the frames."""

    def __init__(
        self,
        opener: Opener,
        config: Config,
        sinks: Sequence[Sink] = (),
        *,
        realtime: bool | None = None,
        applied: Sequence[Applied] | None = None,
        log: LogOptions | None = None,
        folders: MapFolders | None = None,
        viewer: ViewerOptions | None = None,
        delays: int | None = None,
        opened: Callable[[], None] | None = None,
        images: Callable[[SlotImage], None] | None = None,
        silent_s: float | None = None,
    ) -> None:
        """Prepare a run.

        Args:
            opener: opens the source in the capture process; must survive pickling.
            config: what decides the result.
            sinks: get every message of the run but the images, in this process.
            realtime: drop images and take updates as they come; None: as the source says (`live`).
            applied: schedule of an earlier realtime run to repeat.
            log: write everything to an MCAP file.
            folders: maps to load and to save.
            viewer: show the run while it goes on.
            delays: seed of random delays in every stage, for tests.
            opened: called when the source is open, before anything is written.
            images: takes each image in place of a log, and calls `release` when it was read.
            silent_s: a stage that does not respond for so long ends the run; None: it is only reported.
        """
        self._opener, self._config, self._sinks = opener, config, list(sinks)
        self._realtime, self._applied, self._log, self._delays = realtime, applied, log, delays
        self._folders, self._viewer = folders or MapFolders(), viewer
        self._opened, self._images, self._silent_s = opened, images, silent_s
        self._context = _context()
        self._processes: dict[str, BaseProcess] = {}
        self._reports: dict[Connection, str] = {}
        self._controls: dict[str, Connection] = {}
        self._to_logger: Outbox | None = None
        self._live = False  # the logger is never waited for
        self._left_out = 0  # images missing in the log
        self._abandoned = False
        self.began_s: float | None = None  # performance counter when every stage was ready
        self._release: Outbox | None = None
        self._to_viewer: DroppingOutbox | None = None
        self._next_picture_ns = 0
        self._ring: ImageRing | None = None
        self._ended: set[str] = set()
        self._early_messages: list[object] | None = []  # while the source was opened
        self._waiting = {"tracker", "mapper", "loop"}  # not ready yet
        self._stopped_s: float | None = None  # when a stop was requested
        self._progress_s = time.monotonic()  # of the last message other than a heartbeat
        self._look_s = self._listened_s = time.monotonic()
        self._over_s: float | None = None  # when the last stage had ended
        self._woken, self._wake = self._pipe()  # `stop` may be called while the next message is awaited
        self._failure: StereoSfmError | None = None  # of the source: raised when all its images are processed
        self._listener = Listener("main", self.publish)
        self.info: SourceInfo

    # -- life cycle ---------------------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        _raise_file_limit(MIN_OPEN_FILES)
        self._listener.__enter__()
        try:
            self._start()
        except BaseException:
            self._kill_all()
            self._listener.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._reports:
            self._abandon()
        self._kill_all()
        self._listener.__exit__(None, None, None)

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by stage."""
        return {name: p.pid for name, p in self._processes.items() if p.pid is not None}

    def stop(self) -> None:
        """Request the end; everything in flight is finished and written. May be called at any time."""
        if self._stopped_s is not None:
            return
        self._stopped_s = time.monotonic()
        for process in self._processes.values():
            self._wake_up(process)
        for connection in (self._controls.get("capture"), self._wake):
            with contextlib.suppress(OSError):  # capture or the whole run has ended
                if connection is not None:
                    connection.send("stop")

    @staticmethod
    def _wake_up(process: BaseProcess) -> None:
        """A stopped process can neither finish nor close its file."""
        with contextlib.suppress(OSError, AttributeError):
            if process.pid is not None:
                os.kill(process.pid, signal.SIGCONT)

    def __iter__(self) -> Iterator[Frame]:
        with contextlib.suppress(_Finished):
            yield from self._frames()
        if self._failure is not None:
            raise self._failure

    def _frames(self) -> Iterator[Frame]:
        while self._reports:
            ready = wait([*self._reports, self._woken], CHECK_S)
            self._check_stages()
            for connection in ready:
                assert isinstance(connection, Connection)
                try:
                    message = connection.recv()
                    if connection is self._woken:
                        continue
                except (EOFError, OSError):
                    if connection in self._reports:
                        self._died(connection)
                    continue
                if connection in self._reports:  # else it was closed meanwhile
                    frame = self._take(connection, message)
                    if frame is not None:
                        yield frame

    def _take(self, connection: Connection, message: object) -> Frame | None:
        """One message of a stage; returned when it is a frame."""
        self._watchdog.received(self._reports[connection], message)
        if isinstance(message, Heartbeat):
            return None
        self._progress_s = time.monotonic()
        if isinstance(message, Failed):
            self._fail(connection, message)
        elif isinstance(message, End):
            self._end(connection, message.stage)
        elif isinstance(message, Ready):
            self._begin(message.stage)
        else:
            if isinstance(message, LogLine):
                emit(message)
            self._dispatch(message)
        return message if isinstance(message, Frame) else None

    # -- unresponsive stages -----------------------------------------------------------------------------------------

    def _check_stages(self) -> None:
        """Check at intervals for stages that do not respond, and for an end that takes too long.

        Raises:
            _Finished: nothing more is waited for.
        """
        now = time.monotonic()
        if now - self._listened_s > 2 * CHECK_S:  # the consumer of the frames was busy
            self._watchdog.excuse(now - self._listened_s)
            self._progress_s = now
        self._listened_s = now
        if now < self._look_s:
            return
        self._look_s = now + CHECK_S
        waiting = set(self._reports.values())
        silent = self._watchdog.silent(sorted(waiting - {"viewer"}))
        if silent and self._silent_s is not None and self._stopped_s is None:
            self._abandon()
            raise StageDied(f"the {silent[0]} process does not respond")
        if waiting == {"viewer"}:
            self._over_s = self._over_s or now
            if now - self._over_s > VIEWER_GRACE_S:
                raise _Finished
        elif self._stopped_s is not None:
            self._enforce_end(now - self._stopped_s, now, silent)

    def _enforce_end(self, waited_s: float, now: float, silent: list[str]) -> None:
        """After a stop request: end the stages that do not end by themselves.

        A stage may take time while it works: for a map to be saved as long as it needs, for files as long
        as it makes progress, for a live camera `END_S`.
        """
        if waited_s > STOP_GRACE_S and "capture" in self._reports.values():
            self._processes["capture"].kill()  # it is waiting for an image
            return
        hurry = bool(silent) or self._folders.map_out is None
        if waited_s > END_S and hurry and (self._live or now - self._progress_s > END_S):
            self._end_now()

    def _end_now(self) -> None:
        missing = " and the ".join(sorted(set(self._reports.values()) - {"viewer"}))
        log.warning("ended without waiting for the %s", missing)
        self._abandon()
        raise _Finished

    # -- start -------------------------------------------------------------------------------------------------------

    def _start(self) -> None:
        pipe = self._pipe
        images, updates = pipe(), pipe()
        to_mapper, to_loop, loops = pipe(), pipe(), pipe()
        jobs, results = pipe(), pipe()
        tracker_free, second_free = pipe(), pipe()
        logged = pipe()
        readers = (tracker_free[0], second_free[0])
        self._spawn("capture", workers.run_capture, self._opener, self._control("capture"), images[1], readers)
        self._spawn(
            "tracker", workers.run_tracker, self._control("tracker"), images[0], tracker_free[1], updates[0],
            to_mapper[1], to_loop[1],
        )  # fmt: skip
        self._spawn(
            "mapper", workers.run_mapper, self._control("mapper"), to_mapper[0], loops[0], updates[1], jobs[1],
            results[0],
        )  # fmt: skip
        self._spawn("loop", workers.run_loop, self._control("loop"), to_loop[0], loops[1])
        self._spawn("optimizer", workers.run_optimizer, self._control("optimizer"), jobs[0], results[1])
        keep: list[Connection] = []
        if self._log is not None:
            self._spawn("logger", logger.run_logger, self._control("logger"), logged[0], second_free[1], self._log)
            keep = [logged[1]]
        else:
            self._release = Outbox(second_free[1], 64)
            keep = [second_free[1]]
        if self._viewer is not None:
            shown = pipe()
            self._spawn("viewer", workers.run_viewer, self._control("viewer"), shown[0], self._viewer)
            shown[0].close()
            self._to_viewer = DroppingOutbox(shown[1])
        for ends in (images, updates, to_mapper, to_loop, loops, jobs, results, tracker_free, second_free, logged):
            for end in ends:
                if end not in keep:
                    end.close()  # only the workers hold these: their death must be seen as an end of file
        self._watchdog = Watchdog(self.pids, log.warning, self._silent_s)
        info = self._first_report()
        self._live = info.live if self._realtime is None else self._realtime
        if self._log is not None:
            self._to_logger = Outbox(logged[1], BACKLOG if self._live else 0)
        if self._opened is not None:
            self._opened()
        self._set_up(info)
        early, self._early_messages = self._early_messages, None
        for line in early or ():
            self._dispatch(line)

    def _set_up(self, info: SourceInfo) -> None:
        self.info = info
        self._ring = ImageRing(ImageLayout.of(info.rig), self._config.pipeline.ring_slots)
        applied = None if self._applied is None else tuple(self._applied)
        setup = Setup(
            rig=info.rig,
            config=self._config,
            ground_truth=info.ground_truth,
            source_name=self._opener.spec or info.name,
            ring_name=self._ring.name,
            applied=applied,
            realtime=self._live,
            folders=self._folders,
            delays=self._delays,
            opening=self._folders.opening(self._opener.opening),
        )
        jpeg = self._log is not None and self._log.image_format == "jpeg"
        for stage, control in self._controls.items():
            with contextlib.suppress(OSError):  # it died: its report gives the reason
                control.send((setup, jpeg) if stage == "capture" else setup)
        if self._stopped_s is not None:
            self._controls["capture"].send("stop")  # requested while the source was being opened

    def _begin(self, stage: str) -> None:
        """Start capture when the last of the other stages is ready."""
        self._waiting.discard(stage)
        if not self._waiting:
            self.began_s = time.perf_counter()
            with contextlib.suppress(OSError):
                self._controls["capture"].send("go")

    def _pipe(self) -> tuple[Connection, Connection]:
        """(receiving end, sending end)."""
        return self._context.Pipe(duplex=False)

    def _control(self, stage: str) -> Connection:
        receive, send = self._pipe()
        self._controls[stage] = send
        return receive

    def _spawn(self, stage: str, body: Callable[..., None], *args: Any) -> None:
        report, send = self._pipe()
        process = self._context.Process(
            target=workers.guarded, args=(stage, body, send, *args), name=f"stereo-sfm {stage}", daemon=True
        )
        with ignored_by_children(), thread_environment(self._config.pipeline.threads):
            process.start()
        send.close()
        if args and isinstance(args[0], Connection):
            args[0].close()
        self._processes[stage] = process
        self._reports[report] = stage

    def _first_report(self) -> SourceInfo:
        """The first message of capture: what the source is, or why it cannot be opened."""
        connection = next(c for c, stage in self._reports.items() if stage == "capture")
        while True:
            arrived = wait([connection], CHECK_S)
            if self._stopped_s is not None and time.monotonic() - self._stopped_s > STOP_GRACE_S:
                raise KeyboardInterrupt  # heartbeats go on arriving
            if not arrived:
                self._watchdog.silent(["capture"])
                continue
            try:
                message = connection.recv()
            except (EOFError, OSError):
                raise StageDied(f"capture {self._how_it_died('capture')} before the source was open") from None
            self._watchdog.received("capture", message)
            if isinstance(message, Failed):
                self._reports.pop(connection)
                raise _error(message)
            if isinstance(message, SourceInfo):
                return message
            if isinstance(message, LogLine):
                emit(message)
                self.publish(message)

    # -- messages ----------------------------------------------------------------------------------------------------

    def publish(self, message: object) -> None:
        """Put a message of the caller's into the run's log, viewer and sinks."""
        if self._early_messages is not None:
            self._early_messages.append(message)
        else:
            self._dispatch(message)

    def _dispatch(self, message: object) -> None:
        if isinstance(message, Compiling | Localized | MapSaved):
            for sink in self._sinks:
                sink.put(message)
            return
        if isinstance(message, LogEnded):
            log.warning("%s; the run continues without it", message.why)
        if isinstance(message, SlotImage) and not message.logged:
            self._leave_out(message.image)
        if not isinstance(message, SlotImage):
            for sink in self._sinks:
                sink.put(message)
        if self._to_viewer is not None:
            self._show(message)
        if self._to_logger is not None:
            self._log_message(message)
        elif isinstance(message, SlotImage) and message.logged:
            (self._images or self.release)(message)

    def release(self, message: SlotImage) -> None:
        """Return the slot of an image that `images` took; from any thread."""
        if self._release is not None:
            self._release.send(message.slot)

    def pixels(self, message: SlotImage) -> StereoImage:
        """A copy of an image whose slot was not returned yet."""
        assert self._ring is not None
        return self._ring.read(message)

    @property
    def ring(self) -> tuple[ImageLayout, int, str]:
        """Of the images in shared memory, for processes that read them: layout, slots, name."""
        assert self._ring is not None
        return self._ring.layout, self._ring.slots, self._ring.name

    def save_map(self, folder: Path) -> None:
        """Request that the map so far is written; `MapSaved` answers. The run goes on meanwhile."""
        self._ask_mapper(folder)

    def relocalize(self) -> None:
        """Request that the whole saved map is searched for the camera with the next keyframe."""
        self._ask_mapper(Relocalize())

    def _ask_mapper(self, request: Path | Relocalize) -> None:
        with contextlib.suppress(OSError):  # the mapper has ended
            self._controls["mapper"].send(request)

    def _leave_out(self, image: StereoImage) -> None:
        """An image for the tracker that the log is too slow to take."""
        if self._to_logger is None or self._log is None or self._log.image_format == "none":
            return
        if not self._left_out:
            log.warning("the log is slower than the camera: some of the images are omitted")
        self._left_out += 1
        self._dispatch(Dropped(image.frame_id, image.stamp_ns, "log", "the log is slower than the camera"))

    def _log_message(self, message: object) -> None:
        """Send to the logger without waiting. When reading files, the slots that it holds make the run wait."""
        assert self._to_logger is not None
        if not self._to_logger.offer(message, 0.0):
            self._give_up_log(f"the logger has not taken the last {BACKLOG} messages")

    def _show(self, message: object) -> None:
        """Forward to the viewer what it can take, without waiting."""
        assert self._to_viewer is not None and self._ring is not None
        if not isinstance(message, SlotImage):
            self._to_viewer.send(message)
        elif message.logged and message.image.stamp_ns >= self._next_picture_ns:
            self._next_picture_ns = message.image.stamp_ns + PICTURE_NS
            self._to_viewer.send(self._ring.read(message))

    def _end(self, connection: Connection, stage: str) -> None:
        self._ended.add(stage)
        self._reports.pop(connection, None)
        connection.close()
        if {s for s in self._processes if s not in SINKS} <= self._ended and stage not in SINKS:
            if self._to_logger is not None:
                self._to_logger.send(End("main"))
            if self._to_viewer is not None:
                self._to_viewer.send(End("main"))
                self._to_viewer.close()

    # -- failures ----------------------------------------------------------------------------------------------------

    def _how_it_died(self, stage: str) -> str:
        process = self._processes[stage]
        process.join(0.5)
        code = process.exitcode
        if code is not None and code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"

    def _died(self, connection: Connection) -> None:
        """End of file without `End`: find the one that died first, close the log, raise."""
        stage = self._reports.pop(connection)
        if stage == "viewer":  # closed or crashed: the run continues
            self._ended.add(stage)
            return
        if stage == "logger" and self._live:
            self._give_up_log(f"the {stage} process {self._how_it_died(stage)}")
            return
        if stage == "capture" and (self._stopped_s is not None or not self._waiting):
            if self._stopped_s is None:
                died = self._how_it_died(stage)
                self._failure = StageDied(f"the {stage} process {died}; {self._what_remains(stage)}")
            self._end(connection, stage)
            return
        self._processes[stage].join(0.5)
        consequence = self._processes[stage].exitcode == workers.UPSTREAM_LOST
        if consequence and any(s not in SINKS for s in self._reports.values()):
            return  # another stage is the cause, and will be found
        message = f"the {stage} process {self._how_it_died(stage)}"
        self._abandon()
        raise StageDied(f"{message}; {self._what_remains(stage)}")

    def _what_remains(self, stage: str) -> str:
        if self._log is None:
            return "the run has no log"
        if stage == "logger" and not self._log.path.exists():
            return "there is no log"
        if self._open_log():
            return f"the log {self._log.path} is not closed, but readable (stereo-sfm recover writes a clean copy)"
        return f"the log {self._log.path} is complete up to that point"

    def _fail(self, connection: Connection, failed: Failed) -> None:
        if failed.stage == "viewer":
            log.warning("the viewer stopped: %s", failed.message.strip().splitlines()[-1])
            self._reports.pop(connection)
            self._ended.add("viewer")
            return
        if failed.stage == "logger" and self._live and not failed.ours:
            self._reports.pop(connection)
            self._give_up_log(f"the logger failed: {failed.message.strip().splitlines()[-1]}")
            return
        if failed.stage == "capture" and not self._waiting:
            self._failure = _error(failed)
            self._end(connection, failed.stage)
            return
        self._abandon()
        if self._failure is not None:
            log.warning("%s", failed.message)
            raise self._failure
        raise _error(failed)

    def _abandon(self) -> None:
        """Kill every stage but the logger, which closes its file; if it cannot, main does."""
        if self._abandoned:
            return
        self._abandoned = True
        for stage, process in self._processes.items():
            if stage != "logger" and process.is_alive():
                process.kill()
        logger = self._processes.get("logger")
        if logger is None or self._to_logger is None or "logger" in self._ended:
            return
        until = time.monotonic() + GRACE_S
        if logger.is_alive():
            self._wake_up(logger)
            self._to_logger.offer(End("main", early=True), GRACE_S)
        logger.join(max(until - time.monotonic(), 0.0))
        self._close_log(logger)

    def _give_up_log(self, why: str) -> None:
        """Continue the run without a log."""
        logger, self._to_logger = self._processes["logger"], None
        for connection in [c for c, stage in self._reports.items() if stage == "logger"]:
            del self._reports[connection]
            connection.close()
        self._ended.add("logger")
        self._close_log(logger)
        assert self._log is not None
        self._dispatch(LogEnded(f"{why}: {self._log.path} ends here"))

    def _close_log(self, logger: BaseProcess) -> None:
        """End the logger and the file that it left open."""
        if logger.is_alive():
            logger.kill()
        logger.join()
        if self._log is not None and logger.exitcode != 0 and self._open_log():
            from stereo_sfm.log.provenance import ENDED_EARLY, METADATA
            from stereo_sfm.log.repair import finish_in_place

            with contextlib.suppress(OSError, StereoSfmError):  # no room for its index: it is readable nevertheless
                finish_in_place(self._log.path, (METADATA, ENDED_EARLY))

    def _open_log(self) -> bool:
        """Whether the log was not closed."""
        from stereo_sfm.log.scan import is_closed

        return self._log is not None and self._log.path.exists() and not is_closed(self._log.path)

    def _kill_all(self) -> None:
        """End every process; also an interruption leaves nothing in shared memory."""
        try:
            until = time.monotonic() + EXIT_S
            for stage, process in self._processes.items():
                if stage in self._ended:  # it has sent its last message and is about to exit
                    process.join(max(until - time.monotonic(), 0.0))
                if process.is_alive():
                    process.kill()
            for process in self._processes.values():
                process.join()
        finally:
            for connection in (*self._reports, *self._controls.values(), self._woken, self._wake):
                connection.close()
            self._reports.clear()
            if self._ring is not None:
                self._ring.close()
                self._ring = None


class _Finished(Exception):
    """Nothing more is waited for."""


def _context() -> SpawnContext | ForkServerContext:
    """How stages are started: forked from a process that has loaded their code and started no thread, where possible.

    They share its memory, and none takes a second to load the same code.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["stereo_sfm.pipeline.preload"])
    return context


def _raise_file_limit(least: int) -> None:
    """Raise the limit of open files for this process and its children.

    Raises:
        StereoSfmError: the system does not allow it.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < least:
        if hard != resource.RLIM_INFINITY and hard < least:
            raise StereoSfmError(f"only {hard} files may be open, a run needs {least}: raise 'ulimit -n', or --inline")
        resource.setrlimit(resource.RLIMIT_NOFILE, (least, hard))


def _error(failed: Failed) -> StereoSfmError:
    if not failed.ours:
        return StageDied(f"the {failed.stage} process failed:\n{failed.message}")
    error = StereoSfmError(failed.message)
    error.exit_code = failed.exit_code
    return error
