"""Progress on a terminal, the same for every command: count, rate, time left, state. Nothing without a terminal."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import TYPE_CHECKING, Self

from stereo_sfm.messages import Compiling

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

    def step(self, state: str, line: str = "") -> None:
        """One more is done; `line` is printed above the bar and stays."""

    def show(self, state: str) -> None:
        """Show a state before the next step is done."""


class TerminalProgress(NoProgress):
    """A bar on standard error."""

    def __init__(self, name: str, total: int | None, unit: str = "frames", done: int = 0, state: str = "") -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]:>6} " + f"{unit}/s"),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.fields[state]}"),
            console=Console(stderr=True),
            transient=True,
        )
        self._task = self._progress.add_task(name, total=total, completed=done, rate="-", state=state)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def step(self, state: str, line: str = "") -> None:
        speed = self._progress.tasks[0].speed
        self._progress.update(self._task, advance=1, rate=f"{speed:.1f}" if speed else "-", state=state)
        if line:
            self._progress.console.print(line, markup=False, highlight=False)

    def show(self, state: str) -> None:
        self._progress.update(self._task, state=state)


class LinesOnly(NoProgress):
    """Without a terminal: prints only the permanent lines."""

    def step(self, state: str, line: str = "") -> None:
        if line:
            print(line, file=sys.stderr)


def progress(
    name: str, total: int | None, quiet: bool, unit: str = "frames", done: int = 0, state: str = ""
) -> NoProgress:
    """A progress bar if standard error is a terminal and `quiet` is false.

    Args:
        name: of the task. total: number of steps, None if unknown. done: steps done before.
        quiet: show nothing. unit: what is counted. state: text beside the bar until the first step.
    """
    if quiet:
        return NoProgress()
    return TerminalProgress(name, total, unit, done, state) if sys.stderr.isatty() else LinesOnly()


class CompilationProgress:
    """A sink that shows which kernel the first run on a machine is compiling."""

    def __init__(self) -> None:
        self.bar = NoProgress()
        self._kernels = 0

    def put(self, message: object) -> None:
        """Take any message of a run."""
        if not isinstance(message, Compiling):
            return
        self._kernels += 1
        if self._kernels == 1 and isinstance(self.bar, LinesOnly):
            print("first run on this machine: compiling the numerical kernels, a minute or two", file=sys.stderr)
        self.bar.show(f"first run here: compiling {message.kernel} ({message.stage}), kernel {self._kernels}")


def frame_state(frame: Frame) -> str:
    """The state of a frame beside the progress bar."""
    state = frame.state.name if not frame.reason else f"{frame.state.name} ({frame.reason})"
    return f"{state} · {int(frame.observations.inlier.sum())} points"
