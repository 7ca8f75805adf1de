"""One pipeline after another: started again when a stage died or on request, until the source ends or a stop."""

from __future__ import annotations

import gc
import logging
import threading
import time

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import Opener, SourceChoice, with_known_start, with_start_check
from stereo_sfm.drivers.start_checked import RigChanged
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.pipeline.processes import StageDied
from stereo_sfm.pipeline.standby import Standby
from stereo_sfm.service.camera import same_camera
from stereo_sfm.service.health import HealthCollector
from stereo_sfm.service.hub import Hub
from stereo_sfm.service.map_keeper import MapKeeper
from stereo_sfm.service.recorder import Recorder
from stereo_sfm.service.robot_mounting import RobotMounting
from stereo_sfm.service.session import Session
from stereo_sfm.service.states import Facts

log = logging.getLogger("stereo_sfm")

REOPEN_S = 1.0  # between two attempts to open the camera
STABLE_S = 5.0  # a pipeline that has tracked for less counts as a failed start
IMMEDIATE_RESTARTS, LONGEST_PAUSE_S = 3, 30.0  # after failed starts in a row; then the pauses double


class Pipelines:
    """The sessions of a service. `run` blocks until the end; the rest may be called in any thread."""

    def __init__(
        self,
        opener: Opener,
        config: Config,
        silent_s: float,
        maps: MapKeeper,
        recorder: Recorder,
        hub: Hub,
        facts: Facts,
        health: HealthCollector,
    ) -> None:
        """Args:
        opener: of the source. config: of the stages. silent_s: after which a stage counts as hung.
        maps, recorder, hub, health: what each session uses. facts: kept up to date.
        """
        self._opener = with_start_check(opener, config.self_calibration.mode == "auto")
        self._config, self._silent_s = config, silent_s
        self._maps, self._recorder, self._hub = maps, recorder, hub
        self._facts, self._health = facts, health
        self._mounting = RobotMounting()
        self.session: Session | None = None  # the one that runs
        self._standby: Standby | None = None  # the stages of the next one
        self._standby_lock, self._standby_after_s = threading.Lock(), 0.0
        self.count = 0  # pipelines started so far
        self._restarting = False  # the pipeline is stopped to be started again
        self._failures = 0  # starts in a row that failed
        self.stopping = threading.Event()
        self.stopped_s = 0.0  # monotonic time of the stop
        self.map_complete = False  # the last session's mapper came to its end

    @property
    def stopping_s(self) -> float:
        """Seconds since the stop, 0 before it."""
        return time.monotonic() - self.stopped_s if self.stopping.is_set() else 0.0

    @property
    def tracking_session(self) -> Session | None:
        """The session, once its first image has come."""
        return None if self._facts.starting else self.session

    def check(self) -> None:
        """Have the stages of the next pipeline wait while this one is stable; call it regularly, also after the end."""
        session = self.session
        stable = session is not None and session.tracking_s > STABLE_S and not self.stopping.is_set()
        with self._standby_lock:
            if self._standby is not None and (self.stopping.is_set() or not self._standby.alive):
                self._standby.close()
                self._standby, self._standby_after_s = None, time.monotonic() + LONGEST_PAUSE_S
            due = self._standby is None and time.monotonic() >= self._standby_after_s
            if session is not None and stable and due:
                gc.collect()  # the session before this one, a cycle of objects with open files; it takes 70 ms
                self._standby = Standby(self._config, session.source.rig, session.source.modules)

    def _take_standby(self) -> Standby | None:
        """What waits for the next pipeline, if all of it does."""
        with self._standby_lock:
            standby, self._standby = self._standby, None
        if standby is not None and not standby.alive:
            standby.close()
            return None
        return standby

    def run(self) -> None:
        """Run pipelines until the source ends or `stop`.

        Raises:
            StereoSfmError: a pipeline cannot be started, and another attempt would not help.
        """
        while not self.stopping.is_set():
            ended = self._run_once()
            if ended and not self._restarting:
                self.stop("the source has ended")
                return
            if ended:
                self._facts.starting = "the map is being saved"
                self._maps.settle()
            self._restarting = False
            if not ended:
                self.stopping.wait(REOPEN_S if self._facts.source_error else _pause_s(self._failures))

    def stop(self, why: str) -> None:
        """Save the map of the session and end it; no other follows."""
        if self.stopping.is_set():
            return
        self._facts.stopping = why
        self.stopped_s = time.monotonic()
        self.stopping.set()
        session = self.session
        self._maps.save_last(session if session is not None and session.frames else None)
        if session is not None:
            session.stop()

    def restart(self, why: str) -> None:
        """Stop the pipeline; another one is started."""
        log.info("%s: the pipeline is started again", why)
        self._restarting = True
        session = self.session
        if session is not None:
            session.stop()

    def _run_once(self) -> bool:
        """One pipeline; whether it came to its end.

        Raises:
            StereoSfmError: it cannot be started, and trying again would not help.
        """
        self.count += 1
        self._facts.starting = self._facts.starting or "the pipeline is starting"
        try:
            folders = self._maps.begin()
        except StereoSfmError as error:
            if self.count == 1:
                raise
            self._failures += 1
            self._not_started(error)
            return False
        session = self.session = Session(
            self.count, self._opener, self._config, folders, self._hub, self._facts, self._health,
            self._silent_s, self._recorder, self._maps.session_saved, self._mounting,
            None if self._maps.mode == "none" else self._maps.folder, self._take_standby,
        )  # fmt: skip
        if self.stopping.is_set():
            return True
        try:
            session.run()
            self._failures = 0
            return True
        except RigChanged as found:
            self._opener = with_known_start(self._opener, found.check)
            return False
        except StageDied as error:
            self._health.restarts += 1
            self._failures = 0 if session.tracking_s > STABLE_S else self._failures + 1
            if session.frames:  # poses come sooner: it is the same camera with the same calibration
                self._opener = with_known_start(self._opener, session.start_check)
            self._facts.starting = str(error).partition("\n")[0].partition(";")[0]
            log.error("%s: the pipeline is started again with the newest saved map", self._facts.starting)
            log.info("%s", error)
            return False
        except StereoSfmError as error:
            self._failed(error, session)
            return False
        finally:
            self.session, self.map_complete = None, session.map_complete
            if isinstance(self._opener, SourceChoice):
                self._opener = same_camera(self._opener, session.serial)
                if self._opener.start_check is not None and session.start_check is not None:
                    self._opener = with_known_start(self._opener, session.start_check)  # as corrected since

    def _not_started(self, error: StereoSfmError) -> None:
        """Something else than the camera is the reason."""
        self._facts.starting, self._facts.source_error = str(error), ""
        log.error("%s; the pipeline is not started yet", error)

    def _failed(self, error: StereoSfmError, session: Session) -> None:
        """A camera is waited for; anything else that cannot even be opened is a mistake of the configuration."""
        if not self._opener.device and not session.frames:
            raise error
        if error.stage != "capture":
            self._failures = 0 if session.tracking_s > STABLE_S else self._failures + 1
            self._not_started(error)
            return
        if self._facts.source_error != str(error):
            log.warning("%s; trying again every %.0f s", error, REOPEN_S)
        self._facts.source_error = str(error)


def _pause_s(failures: int) -> float:
    if failures <= IMMEDIATE_RESTARTS:
        return 0.0
    return min(2.0 ** (failures - IMMEDIATE_RESTARTS), LONGEST_PAUSE_S)
