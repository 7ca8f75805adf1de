"""The state of the service, reported to outputs, callbacks, the log and systemd."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from stereo_sfm.recording.segments import AUTOMATIC
from stereo_sfm.service.config import RecordingConfig
from stereo_sfm.service.health import HealthCollector
from stereo_sfm.service.hub import Hub
from stereo_sfm.service.map_keeper import MapKeeper
from stereo_sfm.service.messages import HealthReport, ServiceState, Status
from stereo_sfm.service.notify import SystemdNotifier
from stereo_sfm.service.pipelines import Pipelines
from stereo_sfm.service.recorder import Recorder
from stereo_sfm.service.states import REMEDIES, Facts, derive_state

log = logging.getLogger("stereo_sfm")

EVERY_S = 1.0  # between two reports without a change
_BETWEEN = ServiceState.STARTING, ServiceState.STOPPING


class StatusReporter:
    """Judges the facts and reports the state when it changes, and every second with the health."""

    def __init__(
        self,
        config: RecordingConfig,
        facts: Facts,
        health: HealthCollector,
        maps: MapKeeper,
        recorder: Recorder,
        pipelines: Pipelines,
        hub: Hub,
        notifier: SystemdNotifier,
        pids: Callable[[], Mapping[str, int]],
    ) -> None:
        """Args:
        config: where recordings are, and whether losses are marked.
        facts, health, maps, recorder, pipelines: what is reported. pids: all processes by name.
        hub, notifier: to whom.
        """
        self.config = config
        self._facts, self._health, self._maps, self._recorder = facts, health, maps, recorder
        self._pipelines, self._hub, self._notifier, self._pids = pipelines, hub, notifier, pids
        self.status = Status(ServiceState.STARTING, since_ns=time.time_ns())
        self._next_report_s = self._next_watchdog_s = 0.0

    def report(self) -> None:
        """Report what has changed; call it several times a second, always in the same thread."""
        now = time.monotonic()
        status = self._new_status(now)
        changed = _urgent(status) != _urgent(self.status)
        if status.state != self.status.state:
            self._log_change(status)
        elif status.session != self.status.session and status.state not in _BETWEEN:
            self._notifier.ready()  # a reload has ended, though the camera is still not there
        due = now >= self._next_report_s
        self.status = status
        if changed or due:
            self._hub.publish(status)
            self._notifier.status(_line(status))
        if due:
            self._next_report_s = now + EVERY_S
            self._hub.publish(self.health())
        if self._notifier.watchdog_s and now >= self._next_watchdog_s:
            self._next_watchdog_s = now + self._notifier.watchdog_s
            self._notifier.watchdog()

    def health(self) -> HealthReport:
        """The health now; from any thread."""
        return self._health.report(self._pids(), Path(self.config.folder), self._recorder.state.bytes)

    def _new_status(self, now: float) -> Status:
        recording, session = self._recorder.state, self._pipelines.session
        records = self._recorder.mode != "off"
        self._facts.disk_problem = recording.problem if recording.full and records else ""
        state, reason = derive_state(self._facts, now)
        return Status(
            state=state,
            reason=reason,
            remedy=REMEDIES.get(state, ""),
            since_ns=self.status.since_ns if state == self.status.state else time.time_ns(),
            recording=self._recorder.mode,
            recording_problem=recording.problem if records else "",
            map_folder="" if self._maps.mode == "none" else str(self._maps.folder),
            map_saved_ns=self._maps.saved_ns,
            localized=session is not None and session.localized,
            map_is_new=self._maps.is_new,
            session=self._pipelines.count,
        )

    def _log_change(self, status: Status) -> None:
        log.log(logging.WARNING if status.state in REMEDIES else logging.INFO, "%s", _line(status))
        if status.state == ServiceState.STOPPING:
            self._notifier.stopping()
        elif status.state not in _BETWEEN:
            self._notifier.ready()  # also where the camera is not there yet: the service is
        if status.state == ServiceState.LOST and self.config.mark_losses and self._recorder.mode != "off":
            self._recorder.mark(f"{AUTOMATIC}{status.reason}")


def _line(status: Status) -> str:
    return f"{status.state}{': ' if status.reason else ''}{status.reason}"


def _urgent(status: Status) -> tuple[str, ...]:
    """What is reported at once when it changes."""
    return status.state, status.reason, status.recording, status.recording_problem
