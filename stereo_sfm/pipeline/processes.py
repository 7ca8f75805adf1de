"""One run over processes: main starts the stages, forwards their messages, and ends the run in order."""

from __future__ import annotations

import contextlib
import logging
import math
import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import TracebackType
from typing import Self

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import Opener
from stereo_sfm.drivers.start_checked import RigChanged
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps.folders import MapFolders
from stereo_sfm.messages import Compiling, Localized, LogEnded, LogLine, MapSaved, Relocalize, SaveMap, Sink
from stereo_sfm.pipeline.capture import OpenAgain, SourceInfo
from stereo_sfm.pipeline.channels import Arrivals, End, Failed, pickled
from stereo_sfm.pipeline.child import UPSTREAM_LOST, Ready, Setup
from stereo_sfm.pipeline.images import ImageLayout, ImageRing, SlotImage
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.logger_link import BACKLOG
from stereo_sfm.pipeline.loop_link import LoopLink
from stereo_sfm.pipeline.stage_graph import OuterEnds, start_stages
from stereo_sfm.pipeline.stage_processes import MIN_OPEN_FILES, StageProcesses, raise_file_limit
from stereo_sfm.pipeline.standby import Standby
from stereo_sfm.pipeline.text import Listener, emit
from stereo_sfm.pipeline.viewer import ViewerOptions
from stereo_sfm.pipeline.watchdog import Heartbeat, Watchdog
from stereo_sfm.types import Applied, Frame, Keyframe, LoopResult, StereoImage

log = logging.getLogger("stereo_sfm")

SINKS = {"logger", "viewer"}
OPTIONAL = {"viewer", "dense"}  # a run goes on without them, and never waits for them
CHECK_S = 0.25  # between two checks for processes that do not respond
STOP_GRACE_S = 2.0  # time for capture to react to a stop
IN_FLIGHT_S = 1.0  # time after a stop for images in flight, where the map is written: 0.1 s on a quiet computer
SAVE_END_S = 3.9  # instead of END_S while the map of a session is being written
END_S = 3.0  # time for a live run to end after a stop; for others, the longest time without a message
VIEWER_GRACE_S = 10.0  # time for the viewer to show waiting messages after the run


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
        depth_frames: frozenset[int] | None = None,
        log: LogOptions | None = None,
        folders: MapFolders | None = None,
        viewer: ViewerOptions | None = None,
        delays: int | None = None,
        opened: Callable[[], None] | None = None,
        images: Callable[[SlotImage], None] | None = None,
        silent_s: float | None = None,
        pose_first: bool = False,
        standby: Callable[[], Standby | None] = lambda: None,
    ) -> None:
        """Prepare a run.

        Args:
            opener: opens the source in the capture process; must survive pickling.
            config: what decides the result.
            sinks: get every message of the run but the images, in this process.
            realtime: drop images and take updates as they come; None: by the source (`live`).
            applied: schedule of an earlier realtime run to repeat.
            depth_frames: the images of that run with a live depth.
            log: write everything to an MCAP file.
            folders: maps to load and to save.
            viewer: show the run.
            delays: seed of random delays in every stage, for tests.
            opened: called when the source is open, before anything is written.
            images: takes each image in place of a log, and calls `release` when one that is `logged` was read.
            silent_s: a stage that does not respond for so long ends the run; None: it is only reported.
            pose_first: begin with a live camera's images as soon as there are poses; the map follows.
            standby: called at the start: whose processes are used, without log and viewer only; None: none wait.
        """
        self._opener, self._config, self._sinks = opener, config, list(sinks)
        self._realtime, self._applied, self._log, self._delays = realtime, applied, log, delays
        self._depth_frames = depth_frames
        self._folders, self._viewer = folders or MapFolders(), viewer
        self._opened, self._images, self._silent_s = opened, images, silent_s
        self._pose_first = pose_first
        self._take_standby = standby
        self._stages = StageProcesses(config.pipeline.threads)
        self._outer = OuterEnds()
        self._setup: Setup
        self._live = False  # the logger is never waited for
        self._abandoned = False
        self.began_s: float | None = None  # performance counter when every stage was ready
        self._ring: ImageRing | None = None
        self._ended: set[str] = set()
        self._early_messages: list[object] | None = []  # while the source was opened
        self._not_ready = {"tracker", "mapper", "loop"}
        self._capturing = False
        self._ready_s = math.inf  # when the last of them was ready
        self._held: dict[str, list[object]] = {}  # requests to a stage that begins later than others
        self._set_up_sent = False  # before it, capture takes no other message
        self._saving_at_end = False  # an urgent save was requested, and is not done
        self._saved_at_end = False  # it is done
        self._stopped_s: float | None = None  # when a stop was requested
        self._progress_s = time.monotonic()  # of the last message other than a heartbeat
        self._next_check_s = self._received_s = time.monotonic()
        self._over_s: float | None = None  # when the last stage had ended
        self._woken, self._wake = self._stages.pipe()  # `stop` may be called while the next message is awaited
        self._failure: StereoSfmError | None = None  # of the source: raised when all its images are processed
        self._listener = Listener("main", self.publish)
        self.info: SourceInfo

    @property
    def _loop(self) -> LoopLink:
        assert self._outer.loop is not None
        return self._outer.loop

    # -- life cycle ---------------------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        raise_file_limit(MIN_OPEN_FILES)
        self._listener.__enter__()
        try:
            self._start()
        except BaseException:
            self._close()
            self._listener.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._stages.reports:
            self._abandon()
        self._close()
        self._listener.__exit__(None, None, None)

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by stage."""
        return self._stages.pids

    def stop(self) -> None:
        """Request the end; everything in flight is finished and written. May be called at any time."""
        if self._stopped_s is not None:
            return
        self._stopped_s = time.monotonic()
        for stage in list(self._stages.processes):
            self._stages.resume(stage)
        if self._set_up_sent:
            self._stages.request("capture", "stop")
        else:
            self._stages.give_up()
        with contextlib.suppress(OSError):  # the whole run has ended
            self._wake.send("stop")

    def __iter__(self) -> Iterator[Frame]:
        with contextlib.suppress(_Finished):
            yield from self._frames()
        if self._failure is not None:
            raise self._failure

    def _frames(self) -> Iterator[Frame]:
        reports = self._stages.reports
        arrivals = Arrivals()
        while reports:
            ready = arrivals.wait([*reports, self._woken], CHECK_S)
            self._check_stages()
            for connection in ready:
                try:
                    data = connection.recv_bytes()
                    if connection is self._woken:
                        continue
                except (EOFError, OSError):
                    if connection in reports:
                        self._died(connection)
                    continue
                if connection in reports:  # else it was closed meanwhile
                    frame = self._take(connection, data)
                    if frame is not None:
                        yield frame

    def _take(self, connection: Connection, data: bytes) -> Frame | None:
        """One pickled message of a stage; returned when it is a frame."""
        message = pickle.loads(data)
        if isinstance(message, Heartbeat):  # a step that waits for code which another stage compiles is not long
            since_ready_s = max(time.monotonic() - self._ready_s, 0.0)
            message = Heartbeat(message.stage, min(message.step_s, since_ready_s))
        self._watchdog.received(self._stages.reports[connection], message)
        if isinstance(message, Heartbeat):
            return None
        self._progress_s = time.monotonic()
        if isinstance(message, Failed):
            self._fail(connection, message)
        elif isinstance(message, End):
            self._end(connection, message.stage)
        elif isinstance(message, Ready):
            self._begin(message.stage)
        elif isinstance(message, OpenAgain):
            self._abandon()
            raise RigChanged(message.check)
        else:
            if isinstance(message, LogLine):
                emit(message)
            self._dispatch(message, data)
        return message if isinstance(message, Frame) else None

    # -- unresponsive stages -----------------------------------------------------------------------------------------

    def _check_stages(self) -> None:
        """Check at intervals for stages that do not respond, and for an end that takes too long.

        Raises:
            _Finished: nothing more is waited for.
        """
        now = time.monotonic()
        if now - self._received_s > 2 * CHECK_S:  # the consumer of the frames was busy
            self._watchdog.excuse(now - self._received_s)
            self._progress_s = now
        self._received_s = now
        if now < self._next_check_s:
            return
        self._next_check_s = now + CHECK_S
        waiting = self._stages.waiting
        silent = self._watchdog.silent(sorted(waiting - OPTIONAL))
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
        as it makes progress, for a live camera `END_S`, for a service whose map is written `IN_FLIGHT_S`. Before the
        first image nothing is in flight once the camera is closed.
        """
        if waited_s > STOP_GRACE_S and "capture" in self._stages.waiting:
            self._stages.processes["capture"].kill()  # it is waiting for an image
            return
        if not self._capturing and "capture" not in self._stages.waiting:
            self._end_now()
        hurry = bool(silent) or self._folders.map_out is None or bool(self._not_ready)
        maps = "mapper" not in self._not_ready  # else there is nothing to save yet
        if self._saving_at_end and maps and not silent and waited_s <= SAVE_END_S:
            return
        if waited_s > IN_FLIGHT_S and (self._saved_at_end or (self._saving_at_end and not maps)):
            self._end_now()
        if waited_s > END_S and hurry and (self._live or self._not_ready or now - self._progress_s > END_S):
            self._end_now()

    def _end_now(self) -> None:
        if self._saving_at_end and "mapper" in self._not_ready:
            self._dispatch(MapSaved("", 0, "nothing is mapped yet"))
        if self._capturing:
            missing = " and the ".join(sorted(self._stages.waiting - {"viewer"}))
            log.warning("ended without waiting for the %s", missing)
        self._abandon()
        raise _Finished

    # -- start -------------------------------------------------------------------------------------------------------

    def _start(self) -> None:
        standby = self._take_standby()
        if standby is None:
            self._outer = start_stages(self._stages, self._opener, self._log, self._viewer, self._config.dense.live)
        else:
            self._stages, self._outer = standby.stages, standby.outer
            self._stages.request("capture", self._opener)
        self._watchdog = Watchdog(self.pids, log.warning, self._silent_s)
        info = self._first_report()
        self._live = info.live if self._realtime is None else self._realtime
        if self._outer.logger is not None:
            self._outer.logger.open(self._live)
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
            opening=self._folders.opening(self._opener.opening(info.rig)),
            depth_frames=self._depth_frames,
            pose_first=self._pose_first,
        )
        self._loop.closing = self._config.closes_loops(info.rig.stereo, self._folders.localize_only)
        self._setup = setup
        jpeg = self._log is not None and self._log.image_format == "jpeg"
        if not self._live:
            self._held["mapper"] = [setup]
        elif self._pose_first:
            self._held |= {stage: [setup] for stage in ("mapper", "loop", "optimizer")}
        for stage in self._stages.processes.keys() - self._held.keys():
            self._stages.request(stage, (setup, jpeg) if stage == "capture" else setup)
        self._set_up_sent = True
        if self._stopped_s is not None:
            self._stages.request("capture", "stop")  # requested while the source was being opened

    def _begin(self, stage: str) -> None:
        """Start capture when the tracker is ready, of a live camera when every stage is: its images do not wait.

        Until the tracker is ready, the mapper leaves it the processor; where poses come first, so do the others.
        """
        if stage == "loop":
            self._loop.ready()
        if stage not in self._not_ready:  # of a process that follows one that has died
            return
        self._not_ready.discard(stage)
        if not self._not_ready:
            self.began_s, self._ready_s = time.perf_counter(), time.monotonic()
        if "tracker" not in self._not_ready:
            for held, requests in self._held.items():
                for request in requests:
                    self._stages.request(held, request)
            self._held.clear()
        waited_for = self._not_ready if self._live and not self._pose_first else {"tracker"}
        if not self._capturing and not waited_for & self._not_ready:
            self._capturing = True
            self._stages.request("capture", "go")

    def _request(self, stage: str, message: object) -> None:
        """Send a stage a request, after its set-up."""
        if stage in self._held:
            self._held[stage].append(message)
        else:
            self._stages.request(stage, message)

    def _first_report(self) -> SourceInfo:
        """The first message of capture: what the source is, or why it cannot be opened."""
        connection = self._stages.report_of("capture")
        while True:
            arrived = wait([connection], CHECK_S)
            if self._stopped_s is not None and time.monotonic() - self._stopped_s > STOP_GRACE_S:
                raise KeyboardInterrupt  # heartbeats keep arriving
            silent = self._watchdog.silent(["capture"])
            if silent and self._silent_s is not None:
                raise StageDied("the capture process does not respond")
            if not arrived:
                continue
            try:
                message = connection.recv()
            except (EOFError, OSError):
                raise StageDied(f"capture {self._stages.how_it_died('capture')} before the source was open") from None
            self._watchdog.received("capture", message)
            if isinstance(message, Failed):
                self._stages.reports.pop(connection)
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

    def _dispatch(self, message: object, data: bytes | None = None) -> None:
        """Pass a message on; `data`: the same, pickled."""
        if isinstance(message, LoopResult):
            self._loop.answered(message, data or pickled(message))
        if isinstance(message, Compiling | Localized | MapSaved):
            if isinstance(message, MapSaved) and self._saving_at_end:
                self._saving_at_end, self._saved_at_end = False, True
            for sink in self._sinks:
                sink.put(message)
            return
        if isinstance(message, LogEnded):
            log.warning("%s; the run continues without it", message.why)
        if isinstance(message, SlotImage) and not message.logged and self._outer.logger is not None:
            dropped = self._outer.logger.omitted(message.image)
            if dropped is not None:
                self._dispatch(dropped)
        if not isinstance(message, SlotImage):
            for sink in self._sinks:
                sink.put(message)
        if self._outer.viewer is not None and self._ring is not None:
            self._outer.viewer.put(message, self._ring)
        if self._outer.logger is not None and self._outer.logger.is_open:
            if not self._outer.logger.put(message if data is None else data):
                self._give_up_log(f"the logger has not taken the last {BACKLOG} messages")
        elif isinstance(message, SlotImage):
            if self._images is not None:
                self._images(message)
            elif message.logged:
                self.release(message)

        if isinstance(message, Keyframe):
            self._answer(self._loop.add(message, data or pickled(message)))

    def _answer(self, results: list[LoopResult]) -> None:
        """Loop results that no process has computed."""
        for result in results:
            self._dispatch(result)

    def release(self, message: SlotImage) -> None:
        """Return the slot of an image that `images` took; from any thread."""
        if self._outer.release is not None:
            self._outer.release.send(message.slot)

    def pixels(self, message: SlotImage) -> StereoImage:
        """A copy of an image whose slot was not returned yet."""
        assert self._ring is not None
        return self._ring.read(message)

    @property
    def ring(self) -> tuple[ImageLayout, int, str]:
        """Of the images in shared memory, for processes that read them: layout, slots, name."""
        assert self._ring is not None
        return self._ring.layout, self._ring.slots, self._ring.name

    def save_map(self, folder: Path, urgent: bool = False) -> None:
        """Request that the map so far is written; `MapSaved` follows. The run continues meanwhile.

        Args: folder, replaced. urgent: the run is about to be stopped, which then waits for it up to `SAVE_END_S`.
        """
        self._saving_at_end |= urgent
        self._request("mapper", SaveMap(folder))

    def has_ended(self, stage: str) -> bool:
        """Whether a stage came to its end by itself."""
        return stage in self._ended

    def relocalize(self) -> None:
        """Request that the whole saved map is searched for the camera with the next keyframe."""
        self._request("mapper", Relocalize())

    def _end(self, connection: Connection, stage: str) -> None:
        self._stages.reports.pop(connection, None)
        connection.close()
        if stage == "tracker":
            self._loop.end()
        self._finished(stage)

    def _finished(self, stage: str) -> None:
        """The stage has sent its last message."""
        self._ended.add(stage)
        if self._stages.processes.keys() - SINKS <= self._ended and stage not in SINKS:
            if self._outer.logger is not None:
                self._outer.logger.end()
            if self._outer.viewer is not None:
                self._outer.viewer.end()

    # -- failures ----------------------------------------------------------------------------------------------------

    def _died(self, connection: Connection) -> None:
        """End of file without `End`: find the one that died first, close the log, raise."""
        stage = self._stages.reports.pop(connection)
        if stage == "viewer":  # closed or crashed: the run continues
            self._ended.add(stage)
            return
        if stage == "dense":
            log.warning("live depth ended: its process %s; the run goes on", self._stages.how_it_died(stage))
            self._finished(stage)
            return
        if stage == "logger" and self._live:
            self._give_up_log(f"the {stage} process {self._stages.how_it_died(stage)}")
            return
        if stage == "loop" and self._loop_goes_on(f"the loop closer's process {self._stages.how_it_died(stage)}"):
            return
        # What came before is processed; a service does not wait for that: it begins again.
        goes_on = self._capturing and self._folders.session is None
        if stage == "capture" and (self._stopped_s is not None or goes_on):
            if self._stopped_s is None:
                died = self._stages.how_it_died(stage)
                self._failure = StageDied(f"the {stage} process {died}; {self._what_remains(stage)}")
            self._end(connection, stage)
            return
        consequence = self._stages.exit_code(stage) == UPSTREAM_LOST
        if consequence and self._stages.waiting - SINKS:
            return  # another stage is the cause, and will be found
        message = f"the {stage} process {self._stages.how_it_died(stage)}"
        self._abandon()
        raise StageDied(f"{message}; {self._what_remains(stage)}")

    def _loop_goes_on(self, why: str) -> bool:
        """Have another process follow the loop closer's, else go on without loops; False: it could not even begin."""
        link = self._loop
        if not link.replaceable:
            return False
        self._answer(link.died("process ended"))
        if link.follow():
            log.warning("%s; it starts again", why)
            self._watchdog.begun("loop", self.pids["loop"])
            self._stages.request("loop", self._setup)
        else:
            log.warning("%s; the run goes on without it", why)
            self._finished("loop")
        return True

    def _what_remains(self, stage: str) -> str:
        return "the run has no log" if self._outer.logger is None else self._outer.logger.remains(stage)

    def _fail(self, connection: Connection, failed: Failed) -> None:
        if failed.stage == "viewer":
            log.warning("the viewer stopped: %s", failed.message.strip().splitlines()[-1])
            self._stages.reports.pop(connection)
            self._ended.add("viewer")
            return
        if failed.stage == "dense":
            log.warning("live depth ended: %s; the run goes on", failed.message.strip().splitlines()[-1])
            self._stages.forget("dense")
            self._finished("dense")
            return
        if failed.stage == "logger" and self._live and not failed.ours:
            self._stages.reports.pop(connection)
            self._give_up_log(f"the logger failed: {failed.message.strip().splitlines()[-1]}")
            return
        if failed.stage == "loop" and not failed.ours:
            self._stages.forget("loop")
            if self._loop_goes_on(f"the loop closer's process failed: {failed.message.strip().splitlines()[-1]}"):
                return
        if failed.stage == "capture" and self._capturing:
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
        self._stages.kill({"logger"})
        if self._outer.logger is not None and "logger" not in self._ended:
            self._outer.logger.end_early()

    def _give_up_log(self, why: str) -> None:
        """Continue the run without a log."""
        assert self._outer.logger is not None
        self._ended.add("logger")
        self._dispatch(LogEnded(self._outer.logger.give_up(why)))

    def _close(self) -> None:
        """End every process; also an interruption leaves nothing in shared memory."""
        try:
            self._stages.close(self._ended, wait=not self._abandoned)
        finally:
            self._outer.close()
            for connection in (self._woken, self._wake):
                connection.close()
            if self._ring is not None:
                self._ring.close()
                self._ring = None


class _Finished(Exception):
    """Nothing more is waited for."""


def _error(failed: Failed) -> StereoSfmError:
    if not failed.ours:
        return StageDied(f"the {failed.stage} process failed:\n{failed.message}")
    error = StereoSfmError(failed.message)
    error.exit_code, error.stage = failed.exit_code, failed.stage
    return error
