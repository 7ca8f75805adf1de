"""Progress on a terminal: frames, rate and tracking state. Nothing where there is no terminal."""

from __future__ import annotations

import sys
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from stereo_sfm.types import Frame


class NoProgress:
    """Null object."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def show(self, frame: Frame) -> None:
        """One frame is done."""


def _first_state() -> str:
    """What the bar says before the first frame."""
    compiled = any((Path(__file__).parents[1] / "tracking" / "__pycache__").glob("flow.*.nbi"))
    return "" if compiled else "first run on this machine: compiling, about half a minute"


class TerminalProgress(NoProgress):
    """A bar on standard error."""

    def __init__(self, name: str, total: int | None) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]:>6} frames/s"),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.fields[state]}"),
            console=Console(stderr=True),
            transient=True,
        )
        self._task = self._progress.add_task(name, total=total, rate="-", state=_first_state())

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def show(self, frame: Frame) -> None:
        """One frame is done."""
        speed = self._progress.tasks[0].speed
        state = frame.state.name if not frame.reason else f"{frame.state.name} ({frame.reason})"
        points = int(frame.observations.inlier.sum())
        self._progress.update(
            self._task, advance=1, rate=f"{speed:.1f}" if speed else "-", state=f"{state} · {points} points"
        )


def progress(name: str, total: int | None, quiet: bool) -> NoProgress:
    """A bar if standard error is a terminal and nobody asked for quiet."""
    return NoProgress() if quiet or not sys.stderr.isatty() else TerminalProgress(name, total)
