"""Seconds from SIGTERM to the exit of `stereo-sfm run`, in every state that a run can be in.

    python -m benchmarks stopping -- [--states running logger...] [--repeat 3]

The bundled recording is played at half its speed. In each state the main process gets one SIGTERM (two in those named
"second"); printed are the slowest of the repetitions in seconds, the exit code, and the state of the log. The exit code
is 1 if an end took more than 5 s, a log is not closed, or a process or an image ring is left. The machine should be
quiet: the load is printed.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import psutil

from stereo_sfm.kernel_cache import VARIABLE
from stereo_sfm.log.scan import is_closed
from stereo_sfm.pipeline.images import PREFIX, SHARED

LIMIT_S = 5.0
REACHED_S = 120.0  # for a state to be reached
RUNNING = ("--speed", "0.5")
STAGES = ("capture", "tracker", "mapper", "loop", "optimizer", "logger")  # in the order in which they start


class Run:
    """One `stereo-sfm run` in a folder of its own."""

    def __init__(self, folder: Path, options: tuple[str, ...], environment: dict[str, str]) -> None:
        self.log, self.output, self._messages = folder / "run" / "run.mcap", folder / "run", folder / "messages"
        command = [sys.executable, "-m", "stereo_sfm.cli", "run", "-o", str(self.output), *options]
        with self._messages.open("w") as out:
            self.process = psutil.Popen(command, stdout=out, stderr=out, env=os.environ | environment)
        self.children: list[psutil.Process] = []

    def stages(self) -> dict[str, psutil.Process]:
        """The processes of the stages that have started: grandchildren, in the order of their ids."""
        with contextlib.suppress(psutil.NoSuchProcess):
            self.children = self.process.children(recursive=True)
            below = [p for p in self.children if p.ppid() != self.process.pid]
            return dict(zip(STAGES, sorted(below, key=lambda p: p.pid), strict=False))
        return {}

    def messages(self) -> str:
        """What it has printed."""
        return self._messages.read_text()

    def wait_for(self, what: Callable[[], bool]) -> None:
        """Until something is so.

        Raises:
            TimeoutError: it does not happen.
        """
        until = time.monotonic() + REACHED_S
        while not what():
            if self.process.poll() is not None or time.monotonic() > until:
                raise TimeoutError(f"the state was not reached: {self.messages()}")
            time.sleep(0.01)

    def tracks(self, bytes_: int = 100_000) -> None:
        """Until the log has grown to so many bytes."""
        self.wait_for(lambda: self.log.exists() and self.log.stat().st_size > bytes_)

    def stop(self, stage: str) -> None:
        """Stop the process of a stage; it never responds again."""
        self.stages()[stage].send_signal(signal.SIGSTOP)
        time.sleep(0.5)


def opening(run: Run) -> None:
    """The source does not respond while it is opened."""
    run.wait_for(lambda: "capture" in run.stages())
    run.stop("capture")


def after(seconds: float) -> Callable[[Run], None]:
    """So long after its start."""
    return lambda _: time.sleep(seconds)


def compiling(run: Run) -> None:
    """The first run on a machine."""
    run.wait_for(lambda: "compiling" in run.messages())
    time.sleep(3.0)


def first_image(run: Run) -> None:
    """The camera has sent one image."""
    run.tracks(4096)
    time.sleep(1.0)


def running(run: Run) -> None:
    """In the middle of the recording."""
    run.tracks()
    run.stages()


def stopped(stage: str) -> Callable[[Run], None]:
    """A stage does not respond."""

    def state(run: Run) -> None:
        run.tracks()
        run.stop(stage)

    return state


def appears(name: str) -> Callable[[Run], None]:
    """A file appears in the output folder."""
    return lambda run: run.wait_for((run.output / name).exists)


@dataclass(frozen=True)
class State:
    """How a run is started and brought into a state, and how many signals it gets."""

    reach: Callable[[Run], None]
    options: tuple[str, ...] = RUNNING
    signals: int = 1
    environment: dict[str, str] = field(default_factory=dict[str, str])


STATES = {
    **{f"{seconds:g} s after the start": State(after(seconds)) for seconds in (0.5, 1.0, 1.5, 2.0, 3.0)},
    "opening": State(opening),
    "compiling": State(compiling, environment={VARIABLE: "{folder}/kernels"}),
    "compiling, inline": State(compiling, ("--inline",), environment={VARIABLE: "{folder}/kernels"}),
    "first image": State(first_image, ("--speed", "0.00001")),
    "running": State(running),
    "running, lockstep": State(running, ()),
    "running, inline": State(running, ("--inline",)),
    "running, full log": State(running, (*RUNNING, "--log", "full")),
    **{f"{stage} stopped": State(stopped(stage)) for stage in STAGES},
    **{f"{stage} stopped, lockstep": State(stopped(stage), ()) for stage in STAGES},
    "logger stopped, full log": State(stopped("logger"), (*RUNNING, "--log", "full")),
    "report": State(appears("config.toml"), ()),
    "saving a map": State(running, (*RUNNING, "--map-out", "{folder}/map")),
    "running, second signal": State(running, signals=2),
    "mapper stopped, second signal": State(stopped("mapper"), signals=2),
    "logger stopped, second signal": State(stopped("logger"), signals=2),
    "report, second signal": State(appears("config.toml"), (), signals=2),
}


def abandoned_rings() -> set[str]:
    """Image rings whose maker has ended: their lock is free."""
    found: set[str] = set()
    for path in SHARED.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError), path.open("rb") as ring:
            fcntl.flock(ring, fcntl.LOCK_EX | fcntl.LOCK_NB)
            found.add(path.name)
    return found


def end(state: State, folder: Path) -> tuple[float, int, list[str]]:
    """Seconds, exit code, and what is wrong after one end."""
    before = abandoned_rings()
    filled = [option.format(folder=folder) for option in state.options]
    environment = {name: value.format(folder=folder) for name, value in state.environment.items()}
    run = Run(folder, tuple(filled), environment)
    try:
        state.reach(run)
        begin = time.monotonic()
        for k in range(state.signals):
            time.sleep(0.3 * k)
            run.process.terminate()
        code = run.process.wait(60.0)
        seconds = time.monotonic() - begin
    except (TimeoutError, subprocess.TimeoutExpired) as error:
        return float("inf"), -1, [str(error)]
    finally:
        run.stages()
        for process in (run.process, *run.children):
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
    time.sleep(0.2)
    wrong = [f"{seconds:.1f} s"] if seconds > LIMIT_S else []
    wrong += ["the log is not closed"] if run.log.exists() and not is_closed(run.log) else []
    wrong += [f"{ring} is left in shared memory" for ring in sorted(abandoned_rings() - before)]
    wrong += ["a traceback"] if "Traceback" in run.messages() else []
    return seconds, code, wrong


def main(args: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", nargs="*", help="only those that begin so")
    parser.add_argument("--repeat", type=int, default=1)
    o = parser.parse_args(args)
    print(f"load {os.getloadavg()[0]:.1f}")
    failed = 0
    for name, state in STATES.items():
        if o.states and not name.startswith(tuple(o.states)):
            continue
        ends: list[tuple[float, int, list[str]]] = []
        for _ in range(o.repeat):
            with tempfile.TemporaryDirectory() as folder:
                ends.append(end(state, Path(folder)))
        seconds, code, _ = max(ends, key=lambda found: found[0])
        wrong = sorted({text for _, _, texts in ends for text in texts})
        failed += bool(wrong)
        print(f"{name:34s}{seconds:6.2f} s  exit {code:3d}  {'; '.join(wrong)}", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
