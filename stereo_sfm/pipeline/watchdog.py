"""Detects processes that do not respond. Each sends heartbeats with the duration of its current step.

Nothing here affects what a run computes: a stage never waits for its own heartbeat, and main only reports those it
misses.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

HEARTBEAT_S = 0.25
SILENT_S = 3.0  # without a message from an idle process
LONG_STEP_S = 10.0  # for one image, one keyframe, or one read from the source
STOPPED = {"T": "stopped by a signal", "t": "held by a debugger"}
PROCESS_STATES = {**STOPPED, "D": "waiting for a disk or a device"}


@dataclass(frozen=True)
class Heartbeat:
    """Sent regularly by each process."""

    stage: str
    step_s: float  # duration of the current step; 0 while the process waits for work


class HeartbeatThread:
    """While entered, a thread sends heartbeats; the stage marks its steps with `begin` and `end`."""

    def __init__(self, stage: str, send: Callable[[Heartbeat], None]) -> None:
        self._stage, self._send = stage, send
        self._since: float | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def begin(self) -> None:
        """Mark the beginning of a step."""
        self._since = time.monotonic()

    def end(self) -> None:
        """Mark the end of the step."""
        self._since = None

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()

    def _work(self) -> None:
        while not self._over.wait(HEARTBEAT_S):
            since = self._since
            self._send(Heartbeat(self._stage, 0.0 if since is None else time.monotonic() - since))


class Watchdog:
    """Keeps the time of the last message of each process, and reports each silence once."""

    def __init__(self, pids: Mapping[str, int], report: Callable[[str], None], silent_s: float | None = None) -> None:
        self._pids, self._report = dict(pids), report
        self._limit_s = SILENT_S if silent_s is None else silent_s
        now = time.monotonic()
        self._received_s = dict.fromkeys(pids, now)
        self._computed = dict.fromkeys(pids, 0.0)  # processor seconds
        self._reported: dict[str, float] = {}  # start of each reported silence
        self._long: set[str] = set()

    def received(self, stage: str, message: object) -> None:
        """Take any message of a process."""
        if stage in self._received_s:
            self._received_s[stage] = time.monotonic()
            if isinstance(message, Heartbeat):
                self._computed[stage] = _status(self._pids[stage])[1]
                self._judge_step(message)

    def begun(self, stage: str, pid: int) -> None:
        """Another process of a stage follows one that has ended."""
        self._pids[stage], self._received_s[stage], self._computed[stage] = pid, time.monotonic(), 0.0

    def excuse(self, seconds: float) -> None:
        """Ignore a time in which main did not receive messages."""
        self._received_s = {stage: at + seconds for stage, at in self._received_s.items()}

    def silent(self, stages: Iterable[str]) -> list[str]:
        """The stages that do not respond; the beginning and the end of each silence are reported."""
        now, found = time.monotonic(), list[str]()
        for stage in stages:
            if self._silent_s(stage, now) > self._limit_s:
                found.append(stage)
                self._report_silence(stage, now)
            elif stage in self._reported:
                self._report(f"the {stage} responds again after {now - self._reported.pop(stage):.0f} s")
        return found

    def _silent_s(self, stage: str, now: float) -> float:
        """Seconds of silence; a process that computes is not silent, even if a library blocks its other threads.

        Nor is it while one of its pages is read: its processor time since the last check counts, not its state now.
        """
        if now - self._received_s[stage] > self._limit_s:
            state, computed = _status(self._pids[stage])
            busy = computed > self._computed[stage] or _runnable(self._pids[stage])
            if busy and state not in STOPPED:
                self._computed[stage], self._received_s[stage] = computed, now
        return now - self._received_s[stage]

    def _report_silence(self, stage: str, now: float) -> None:
        if stage in self._reported:
            return
        self._reported[stage] = self._received_s[stage]
        why = PROCESS_STATES.get(_status(self._pids[stage])[0], "")
        self._report(
            f"the {stage} has not responded for {now - self._received_s[stage]:.0f} s" + (f": {why}" if why else "")
        )

    def _judge_step(self, beat: Heartbeat) -> None:
        if beat.step_s < LONG_STEP_S:
            self._long.discard(beat.stage)
        elif beat.stage not in self._long:
            self._long.add(beat.stage)
            what = "waited for the source" if beat.stage == "capture" else "been busy with one step"
            self._report(f"the {beat.stage} has {what} for {beat.step_s:.0f} s")


def process_state(pid: int) -> str:
    """State of a process as Linux names it, such as `STOPPED`; '' where that is not known."""
    return _status(pid)[0]


def _runnable(pid: int) -> bool:
    """Whether a thread of the process waits for a core: the computer is overloaded, not the process stuck."""
    try:
        stats = [path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/stat")]
    except OSError:
        return False
    return any(text.rpartition(")")[2].split()[0] == "R" for text in stats)


def _status(pid: int) -> tuple[str, float]:
    """State of a process as Linux names it and processor seconds it has used; ('', 0) where that is not known."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return "", 0.0
    return fields[0], float(fields[11]) + float(fields[12])
