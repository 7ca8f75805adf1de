"""`Service`: a source tracked without end, its map kept, its pose given to others; from Python and for `serve`."""

from __future__ import annotations

import dataclasses
import logging
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from datetime import datetime
from operator import attrgetter
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from stereo_sfm.config import parse_override
from stereo_sfm.drivers.choice import Opener, SourceChoice
from stereo_sfm.errors import StereoSfmError, one_of
from stereo_sfm.maps.unfinished import copy_map
from stereo_sfm.messages import LogLine, MapSaved
from stereo_sfm.pipeline.processes import StageDied
from stereo_sfm.pipeline.text import Listener
from stereo_sfm.recording.segments import delete_recording, find_recording, listed, recordings
from stereo_sfm.service.camera import patient, same_camera
from stereo_sfm.service.config import RECORDING_MODES, SEE, RobotConfig, load
from stereo_sfm.service.health import HealthBook
from stereo_sfm.service.hub import Hub
from stereo_sfm.service.link import OutputProcess
from stereo_sfm.service.map_store import MapStore
from stereo_sfm.service.messages import Event, HealthReport, ServiceMessage, ServiceState, Status
from stereo_sfm.service.notify import SystemdNotifier
from stereo_sfm.service.outputs import OUTPUTS
from stereo_sfm.service.publisher import Reply, checked
from stereo_sfm.service.recorder import Recorder
from stereo_sfm.service.session import Session
from stereo_sfm.service.states import REMEDIES, Facts, judge
from stereo_sfm.settings import read

log = logging.getLogger("stereo_sfm")
M = TypeVar("M", bound=ServiceMessage)

TICK_S = 0.1  # between two looks at the state
EVERY_S = 1.0  # between two reports without a change
END_S = 4.5  # for everything to be written after a stop
CAMERA_S = 1.0  # between two attempts to open the camera
SHORT_LIFE_S = 20.0  # a pipeline that ends sooner is started again later and later
PATIENT_DEATHS, LONGEST_PAUSE_S = 3, 30.0  # so many times at once
CHANGEABLE = (  # while running
    "map.save_every_min",
    "recording.quota_gb",
    "recording.quota_percent",
    "recording.min_free_gb",
    "recording.segment_min",
    "recording.black_box_min",
    "recording.mark_before_s",
    "recording.mark_after_s",
    "recording.mark_losses",
)
SAVE_S = 60.0  # for a map to be saved on request


class InternalError(StereoSfmError):
    """An error that is not the user's."""

    exit_code = 1


class Service:
    """Use it in a `with` statement: entering starts it, leaving stops it with everything written.

    Every command of `publisher.COMMANDS` is a method that returns a `Reply`.
    """

    def __init__(
        self,
        config: RobotConfig | str | Path,
        opener: Opener | None = None,
        outputs: Mapping[str, str] | None = None,
        notifier: SystemdNotifier | None = None,
    ) -> None:
        """Args:
        config: or its file.
        opener: of the source, instead of the configuration's.
        outputs: those that may be on, as `outputs.OUTPUTS`.
        notifier: to systemd.

        Raises:
            StereoSfmError: an invalid configuration, or no source.
        """
        self.config = config if isinstance(config, RobotConfig) else load(config)
        self._pipeline = self.config.pipeline()
        self._opener: Opener = patient(self.config.opener()) if opener is None else opener
        table = OUTPUTS if outputs is None else outputs
        on = [name for name in table if self.config.section(name).enabled]
        self._hub = Hub(OutputProcess(name, self.config, self.call, table[name]) for name in on)
        self._store = MapStore(Path(self.config.map.folder), self.config.map.mode, self._pipeline)
        self._notifier = notifier or SystemdNotifier()
        self._facts, self._health = Facts(), HealthBook()
        self._recorder = Recorder(self.config.recording)
        self._listener = Listener("service", self._line)
        self._session: Session | None = None
        self._number = 0
        self._stopping, self._ended = threading.Event(), threading.Event()
        self._stop_s = 0.0
        self._again = False  # the pipeline is stopped to be started again
        self._status = Status(ServiceState.STARTING, since_ns=time.time_ns())
        self._next_report_s = self._next_watchdog_s = 0.0
        self._next_save_s = float("inf")
        self._session_saved, self._map_written = threading.Event(), threading.Event()
        self._save_failed = ""
        self._save_lock = threading.Lock()
        self.error: StereoSfmError | None = None  # why it ended by itself
        self._threads = [
            threading.Thread(target=self._keep_running, name="pipelines", daemon=True),
            threading.Thread(target=self._keep_looking, name="state", daemon=True),
        ]

    # -- life --------------------------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        self._listener.__enter__()
        self._recorder.start()
        for output in self._hub.outputs:
            output.start()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop("the service is being stopped")
        for thread in self._threads:
            thread.join()
        self._hub.close()
        self._listener.__exit__(None, None, None)

    def stop(self, why: str = "asked to stop") -> None:
        """Begin to end, with everything written; `wait` until that is done. May be called in any thread."""
        if self._stopping.is_set():
            return
        self._facts.stopping = why
        self._stop_s = time.monotonic()
        self._stopping.set()
        self._notifier.stopping()
        session = self._session
        if session is not None:
            self._end_session(session)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for the end; False when the time is over before."""
        return self._ended.wait(timeout_s)

    def on(self, kind: type[M], callback: Callable[[M], object]) -> Callable[[], None]:
        """Call back with every message of a kind, in a thread of its own; returns what ends that."""
        return self._hub.on(kind, callback)

    @property
    def pids(self) -> dict[str, int]:
        """Process ids of stages and outputs by name."""
        session = self._session
        stages = {} if session is None else session.pids
        outputs = {o.name: o.pid for o in self._hub.outputs if o.pid is not None}
        saver = {} if self._store.pid is None else {"map saver": self._store.pid}
        recorder = {} if self._recorder.pid is None else {"recorder": self._recorder.pid}
        return {**stages, **outputs, **saver, **recorder}

    # -- pipelines, in a thread of their own -------------------------------------------------------------------------

    def _keep_running(self) -> None:
        deaths = 0  # in a row, each soon after its start
        try:
            while not self._stopping.is_set():
                began = time.monotonic()
                ended = self._run_once()
                if ended and not self._again:
                    self.stop("the source has ended")
                    break
                self._again = False
                deaths = 0 if ended or time.monotonic() - began > SHORT_LIFE_S else deaths + 1
                if not ended:
                    pause = min(2.0 ** (deaths - PATIENT_DEATHS), LONGEST_PAUSE_S) if deaths > PATIENT_DEATHS else 0.0
                    self._stopping.wait(CAMERA_S if self._facts.source_error else pause)
        except StereoSfmError as error:
            self.error = error
            self.stop(str(error))
        except Exception:
            self.error = InternalError(f"the service failed:\n{traceback.format_exc()}")
            self.stop("an error of the service")
        finally:
            closing = threading.Thread(target=self._recorder.close)
            closing.start()
            self._finish_map()
            closing.join()
            self._ended.set()

    def _run_once(self) -> bool:
        """One pipeline; whether it came to its end.

        Raises:
            StereoSfmError: it cannot be started, and trying again would not help.
        """
        self._number += 1
        self._facts.starting = self._facts.starting or "the pipeline is starting"
        session = self._session = Session(
            self._number, self._opener, self._pipeline, self._store.begin(), self._hub, self._facts, self._health,
            self.config.watchdog.silent_s, self._recorder, self._saved,
        )  # fmt: skip
        self._session_saved.clear()
        self._next_save_s = time.monotonic() + 60 * self.config.map.save_every_min
        if self._stopping.is_set():
            return True
        try:
            session.run()
            return True
        except StageDied as error:
            self._health.restarts += 1
            self._facts.starting = str(error).partition("\n")[0].partition(";")[0]
            log.error("%s: the pipeline is started again with the newest saved map", self._facts.starting)
            log.info("%s", error)
            return False
        except StereoSfmError as error:
            self._source_failed(error, session)
            return False
        finally:
            self._session = None
            if isinstance(self._opener, SourceChoice):
                self._opener = same_camera(self._opener, session.serial)

    def _source_failed(self, error: StereoSfmError, session: Session) -> None:
        """A camera is waited for; anything else that cannot even be opened is a mistake of the configuration."""
        if not self._opener.device and not session.frames:
            raise error
        if self._facts.source_error != str(error):
            log.warning("%s; trying again every %.0f s", error, CAMERA_S)
        self._facts.source_error = str(error)

    def _restart(self, why: str) -> None:
        """Stop the pipeline; another one is started."""
        self._notifier.reloading()
        log.info("%s: the pipeline is started again", why)
        self._again = True
        session = self._session
        if session is not None:
            session.stop()

    # -- the map -----------------------------------------------------------------------------------------------------

    def _end_session(self, session: Session) -> None:
        if self._store.saves:
            self._store.cancel()
            self._session_saved.clear()
            session.save_map(self._store.session)
        session.stop()

    def _saved(self, message: MapSaved) -> None:
        """The session's part is written; in the pipeline's thread."""
        if message.why:
            self._save_failed = message.why
            self._map_written.set()
            log.log(logging.WARNING if message.keyframes else logging.INFO, "the map was not saved: %s", message.why)
            return
        self._session_saved.set()
        if not self._stopping.is_set():
            self._store.join()

    def _finish_map(self) -> None:
        """After the last pipeline: join what it wrote, in the time that is left; else at the next start."""
        if not (self._store.saves and self._session_saved.is_set()):
            return
        self._store.join()
        joined = self._store.joined(max(self._stop_s + END_S - time.monotonic(), 0.0))
        if joined is None:
            self._store.cancel()
            log.warning("the map of this session is joined with %s at the next start", self._store.folder)
        elif joined.why:
            log.warning("the map of this session is not in %s: %s", self._store.folder, joined.why)
        else:
            self._store.finished()
            log.info("the map %s is saved: %d keyframes", self._store.folder, joined.keyframes)

    def _look_at_map(self, now: float) -> None:
        session = self._session
        if self._stopping.is_set() or not self._store.saves:
            return
        if now >= self._next_save_s and session is not None and not self._facts.starting:
            self._next_save_s = now + 60 * self.config.map.save_every_min
            session.save_map(self._store.session)
        joined = self._store.joined()
        if joined is not None:
            self._save_failed = joined.why
            self._map_written.set()
            if joined.why:
                log.warning("the map was not saved: %s", joined.why)
            else:
                log.info("the map %s is saved: %d keyframes", self._store.folder, joined.keyframes)

    # -- the state, in a thread of its own ---------------------------------------------------------------------------

    def _keep_looking(self) -> None:
        while not self._ended.is_set():
            now = time.monotonic()
            self._look_at_map(now)
            self._look_at_recording()
            self._tell(now)
            self._ended.wait(TICK_S)

    def _look_at_recording(self) -> None:
        self._recorder.check()
        state = self._recorder.state
        self._facts.disk_problem = state.problem if state.full and self._recorder.mode != "off" else ""

    def _tell(self, now: float) -> None:
        status = self._new_status(now)
        changed = _news(status) != _news(self._status)
        if status.state != self._status.state:
            self._log_change(status)
        due = now >= self._next_report_s
        self._status = status
        if changed or due:
            self._hub.publish(status)
            self._notifier.status(f"{status.state}{': ' if status.reason else ''}{status.reason}")
        if due:
            self._next_report_s = now + EVERY_S
            self._hub.publish(self._report())
        if self._notifier.watchdog_s and now >= self._next_watchdog_s:
            self._next_watchdog_s = now + self._notifier.watchdog_s
            self._notifier.watchdog()

    def _new_status(self, now: float) -> Status:
        state, reason = judge(self._facts, now)
        before, session = self._status, self._session
        return Status(
            state=state,
            reason=reason,
            remedy=REMEDIES.get(state, ""),
            since_ns=before.since_ns if state == before.state else time.time_ns(),
            recording=self._recorder.mode,
            recording_problem="" if self._recorder.mode == "off" else self._recorder.state.problem,
            map_folder="" if self._store.mode == "none" else str(self._store.folder),
            map_saved_ns=self._store.saved_ns,
            localized=session is not None and session.localized,
            session=self._number,
        )

    def _log_change(self, status: Status) -> None:
        bad = status.state in REMEDIES
        text = f"{status.state}{': ' if status.reason else ''}{status.reason}"
        log.log(logging.WARNING if bad else logging.INFO, "%s", text)
        if status.state not in (ServiceState.STARTING, ServiceState.STOPPING):
            self._notifier.ready()  # also where the camera is not there yet: the service is
        if status.state == ServiceState.LOST and self.config.recording.mark_losses and self._recorder.mode != "off":
            self._recorder.mark(f"lost: {status.reason}")

    def _report(self) -> HealthReport:
        return self._health.report(self.pids, Path(self.config.recording.folder), self._recorder.state.bytes)

    def _line(self, line: LogLine) -> None:
        self._hub.publish(Event(time.time_ns(), line.level, line.stage, line.text))

    # -- commands ----------------------------------------------------------------------------------------------------

    def call(self, name: str, arguments: Mapping[str, Any] | None = None) -> Reply:
        """A command by its name; what is refused is a reply that is not ok."""
        try:
            given = checked(name, dict(arguments or {}))
            return getattr(self, name)(**given)
        except (StereoSfmError, OSError) as error:
            return Reply(False, str(error))

    def status(self) -> Reply:
        """State, health and settings that may change."""
        health = dataclasses.asdict(self._report())
        settings = {name: attrgetter(name)(self.config) for name in CHANGEABLE}
        data = {"status": dataclasses.asdict(self._status), "health": health, "settings": settings}
        return Reply(True, str(self._status.state), data)

    def save_map(self, name: str = "") -> Reply:
        """Write the map now; with a name also a copy beside the configured folder."""
        session = self._session
        if not self._store.saves or session is None:
            return Reply(False, f"no map is saved: map.mode is {self._store.mode}, or no pipeline runs")
        to = self._beside(name) if name else None
        with self._save_lock:
            self._map_written.clear()
            self._save_failed = ""
            session.save_map(self._store.session)
            if not self._map_written.wait(SAVE_S):
                return Reply(False, f"the map was not saved within {SAVE_S:.0f} s")
            if self._save_failed:
                return Reply(False, self._save_failed)
            if to is not None:
                copy_map(self._store.folder, to)
        return Reply(True, f"saved to {to or self._store.folder}")

    def load_map(self, name: str) -> Reply:
        """Continue with another saved map beside the configured folder."""
        folder = self._beside(name)
        if not (folder / "map.json").exists():
            return Reply(False, f"there is no map {name}")
        self._store = dataclasses.replace(self._store, folder=folder, _base=None, _process=None, _result=None)
        self._restart(f"map {name}")
        return Reply(True, f"starting with {folder}")

    def reset(self) -> Reply:
        """Start tracking and mapping again with the newest saved map."""
        self._restart("reset")
        return Reply(True, "the pipeline is started again")

    # -- recordings --------------------------------------------------------------------------------------------------

    def start_recording(self, mode: str = "full") -> Reply:
        """Record: full, lean or black_box."""
        self._recorder.set_mode(one_of(mode, RECORDING_MODES[1:], "kind of recording"))
        return Reply(True, f"recording {mode}")

    def stop_recording(self) -> Reply:
        """Record no more."""
        self._recorder.set_mode("off")
        return Reply(True, "no longer recording")

    def mark(self, text: str = "") -> Reply:
        """Keep the recording around now."""
        if self._recorder.mode == "off":
            return Reply(False, "nothing is recorded: nothing can be marked")
        self._recorder.mark(f"{datetime.now().isoformat(timespec='seconds')} {text}".strip())
        log.info("marked: %s", text or "(no text)")
        return Reply(True, "marked")

    def recordings(self) -> Reply:
        """List the recordings."""
        root = Path(self.config.recording.folder)
        return Reply(True, "", {"recordings": [listed(folder) for folder in recordings(root)]})

    def delete_recording(self, id: str) -> Reply:
        """Delete a recording."""
        if id == self._recorder.state.recording:
            return Reply(False, f"{id} is being recorded: stop the recording first")
        delete_recording(Path(self.config.recording.folder), id)
        log.info("the recording %s was deleted", id)
        return Reply(True, f"{id} is deleted")

    def recording_files(self, id: str) -> Reply:
        """The files of a recording."""
        folder = find_recording(Path(self.config.recording.folder), id)
        return Reply(True, "", {"files": [str(path) for path in sorted(folder.iterdir()) if path.is_file()]})

    def relocalize(self) -> Reply:
        """Search the whole saved map for the camera's place."""
        session = self._session
        if session is None or not (self._store.folder / "map.json").exists():
            return Reply(False, "there is no saved map, or no pipeline runs")
        if self._store.mode == "localize":
            session.relocalize()
            return Reply(True, "the whole map is searched with the next keyframe")
        self._restart("relocalize")
        return Reply(True, "the pipeline is started again and searches the saved map")

    def set_setting(self, name: str, value: str) -> Reply:
        """Change a setting that is safe to change while running; it is not written to robot.toml."""
        changed = read(
            self.config, parse_override(f"{one_of(name, CHANGEABLE, 'setting that may change')}={value}"), SEE
        )
        self.config = changed
        self._recorder.change(changed.recording)
        return Reply(True, f"{name} = {value}")

    def _beside(self, name: str) -> Path:
        """The folder of a map next to the configured one.

        Raises:
            StereoSfmError: not a plain name.
        """
        if not name or name.startswith(".") or Path(name).name != name or "\\" in name:
            raise StereoSfmError(f"'{name}' is not a plain name")
        return self._store.folder.with_name(name)


def _news(status: Status) -> tuple[str, ...]:
    """What is told at once when it changes."""
    return status.state, status.reason, status.recording, status.recording_problem
