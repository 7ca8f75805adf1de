"""Who does not answer. Every process says every second that it is there, and for how long it has been at one thing.

Nothing here reaches what a run computes: a stage never waits for its own beat, and main only puts into words what it
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

BEAT_S = 1.0
SILENT_S = 3.0  # without a word from a process that computes nothing
LONG_S = 10.0  # at one image, one keyframe, one answer of the source
WORDS = {"T": "stopped by a signal", "t": "held by a debugger", "D": "waiting for a disk or a device"}


@dataclass(frozen=True)
class Beat:
    """A sign of life."""

    stage: str
    step_s: float  # seconds that the process has been at one step; 0 while it waits for work


class Pulse:
    """While entered, a thread of the process sends its beats; the stage says with `step` when it works."""

    def __init__(self, stage: str, send: Callable[[Beat], None]) -> None:
        self._stage, self._send = stage, send
        self._since: float | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def begin(self) -> None:
        """A step begins."""
        self._since = time.monotonic()

    def end(self) -> None:
        """It is done."""
        self._since = None

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()

    def _work(self) -> None:
        while not self._over.wait(BEAT_S):
            since = self._since
            self._send(Beat(self._stage, 0.0 if since is None else time.monotonic() - since))


class Watchdog:
    """Knows when each process was heard last, and tells once of each silence."""

    def __init__(self, pids: Mapping[str, int], tell: Callable[[str], None]) -> None:
        self._pids, self._tell = dict(pids), tell
        now = time.monotonic()
        self._heard = dict.fromkeys(pids, now)
        self._computed = dict.fromkeys(pids, 0.0)  # processor seconds
        self._told: dict[str, float] = {}  # since when the silence that was told of lasts
        self._long: set[str] = set()

    def hear(self, stage: str, message: object) -> None:
        """Any message of a process."""
        if stage in self._heard:
            self._heard[stage] = time.monotonic()
            if isinstance(message, Beat):
                self._computed[stage] = _status(self._pids[stage])[1]
                self._judge_step(message)

    def excuse(self, seconds: float) -> None:
        """Main did not listen for so long."""
        self._heard = {stage: heard + seconds for stage, heard in self._heard.items()}

    def silent(self, stages: Iterable[str]) -> list[str]:
        """Which of these do not answer; the first time it is told, and as well when one answers again."""
        now, found = time.monotonic(), list[str]()
        for stage in stages:
            if self._silent_s(stage, now) > SILENT_S:
                found.append(stage)
                self._say(stage, now)
            elif stage in self._told:
                self._tell(f"the {stage} answers again after {now - self._told.pop(stage):.0f} s")
        return found

    def _silent_s(self, stage: str, now: float) -> float:
        """A process that computes is no silent one, even where a library lets no other thread of it speak."""
        if now - self._heard[stage] > SILENT_S:
            state, computed = _status(self._pids[stage])
            if computed > self._computed[stage] and state not in WORDS:
                self._computed[stage], self._heard[stage] = computed, now
        return now - self._heard[stage]

    def _say(self, stage: str, now: float) -> None:
        if stage in self._told:
            return
        self._told[stage] = self._heard[stage]
        why = WORDS.get(_status(self._pids[stage])[0], "")
        self._tell(f"the {stage} does not answer for {now - self._heard[stage]:.0f} s" + (f": {why}" if why else ""))

    def _judge_step(self, beat: Beat) -> None:
        if beat.step_s < LONG_S:
            self._long.discard(beat.stage)
        elif beat.stage not in self._long:
            self._long.add(beat.stage)
            what = "waited for the source" if beat.stage == "capture" else "been at one step"
            self._tell(f"the {beat.stage} has {what} for {beat.step_s:.0f} s")


def _status(pid: int) -> tuple[str, float]:
    """State of a process as Linux names it and processor seconds it has used; ('', 0) where that is not known."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return "", 0.0
    return fields[0], float(fields[11]) + float(fields[12])
