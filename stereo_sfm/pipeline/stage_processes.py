"""The processes of a run and main's pipes to them: started one by one, ended together."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import time
from collections.abc import Callable, Set
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.pipeline import child
from stereo_sfm.pipeline.channels import Outbox
from stereo_sfm.pipeline.fork_server import kill_fork_server, resume_helpers, start_context, watched_start
from stereo_sfm.pipeline.interrupts import ignored_by_children
from stereo_sfm.pipeline.threads import thread_environment

EXIT_S = 1.0  # time for the processes to exit after their last messages
ATTEMPTS, ATTEMPT_S = 5, 0.2  # to start a stage: a fork server that was killed takes a moment to be gone
MIN_OPEN_FILES = 128  # per process
OWNERS = "capture", "mapper"  # of a device, of a folder: another process may take it only when they are gone
ANY_NUMBER = 0  # of requests that wait: main never waits for a stage that does not read them


class StageProcesses:
    """Processes by stage, with a pipe for the messages of each to main and one for main's requests.

    Attributes:
        processes: stage -> its process.
        reports: where the messages of each stage arrive -> stage; without those that have ended.
    """

    def __init__(self, threads: int) -> None:
        """Args: threads, that numeric libraries may use in each process."""
        self._context, self._threads = start_context(threads), threads
        self.processes: dict[str, BaseProcess] = {}
        self.reports: dict[Connection, str] = {}
        self._controls: dict[str, Outbox] = {}
        self._starting = self._given_up = False

    def pipe(self) -> tuple[Connection, Connection]:
        """(receiving end, sending end)."""
        return self._context.Pipe(duplex=False)

    def spawn(self, stage: str, body: Callable[..., None], *arguments: Any) -> None:
        """Start a stage with `body(to_main, control, *arguments)`."""
        report, to_main = self.pipe()
        if stage in self._controls:  # of a process that has ended
            self._controls[stage].close()
        control, requests = self.pipe()
        self._controls[stage] = Outbox(requests, ANY_NUMBER)
        process = self._context.Process(
            target=child.guarded, args=(stage, body, to_main, control, *arguments), name=f"stereo-sfm {stage}",
            daemon=True,
        )  # fmt: skip
        with ignored_by_children(), thread_environment(self._threads), watched_start():
            self._start(process)
        to_main.close()
        control.close()
        self.processes[stage] = process
        self.reports[report] = stage

    def _start(self, process: BaseProcess) -> None:
        """Raises:
        StereoSfmError: the fork server was killed, and so were those after it.
        KeyboardInterrupt: `give_up` was called.
        """
        self._starting = True
        try:
            for _ in range(ATTEMPTS):
                if self._given_up:
                    raise KeyboardInterrupt
                with contextlib.suppress(EOFError, ConnectionError):
                    process.start()
                    return
                time.sleep(ATTEMPT_S)
        finally:
            self._starting = False
        raise StereoSfmError(
            "the process that starts the stages was killed again and again: is memory short? try --inline"
        )

    def give_up(self) -> None:
        """Start no more stages, and wait no longer for the fork server, which may still load its code."""
        self._given_up = True
        if self._starting:
            kill_fork_server()

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by stage."""
        return {stage: p.pid for stage, p in list(self.processes.items()) if p.pid is not None}

    @property
    def waiting(self) -> set[str]:
        """The stages that have not ended."""
        return set(self.reports.values())

    def report_of(self, stage: str) -> Connection:
        """Where the messages of a stage arrive."""
        return next(c for c, s in self.reports.items() if s == stage)

    def request(self, stage: str, message: object) -> None:
        """Send a stage a request; nothing where it has ended: its report gives the reason."""
        control = self._controls.get(stage)
        if control is not None:
            control.send(message)

    def forget(self, stage: str) -> None:
        """Receive no more messages of a stage."""
        for connection in [c for c, s in self.reports.items() if s == stage]:
            del self.reports[connection]
            connection.close()

    def resume(self, stage: str) -> None:
        """Continue a process that a signal has stopped: it can neither finish nor close its file."""
        pid = self.processes[stage].pid
        with contextlib.suppress(OSError, AttributeError):
            if pid is not None:
                os.kill(pid, signal.SIGCONT)

    def how_it_died(self, stage: str) -> str:
        """What ended a process, for a message."""
        code = self.exit_code(stage)
        if code is not None and code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"

    def exit_code(self, stage: str) -> int | None:
        """The exit code of a process whose pipe has closed."""
        process = self.processes[stage]
        process.join(0.5)
        return process.exitcode

    def kill(self, but: Set[str] = frozenset()) -> None:
        """Kill the processes that run, without waiting for them."""
        for stage, process in self.processes.items():
            if stage not in but and process.is_alive():
                process.kill()

    def close(self, ended: Set[str], wait: bool = True) -> None:
        """End every process and close the pipes.

        Args: ended, stages that are about to exit by themselves. wait: until all are gone, else only for `OWNERS`: on a
        busy computer the system takes a second to free the memory of those of low priority.
        """
        resume_helpers()  # which tell of the end of each
        try:
            until = time.monotonic() + EXIT_S
            for stage in ended & self.processes.keys():
                self.processes[stage].join(max(until - time.monotonic(), 0.0))
            self.kill()
            until = time.monotonic() + EXIT_S
            for stage, process in self.processes.items():
                if not wait and stage not in OWNERS:
                    continue
                process.join(max(until - time.monotonic(), 0.0))
        finally:
            for end in (*self.reports, *self._controls.values()):
                end.close()
            self.reports.clear()


def raise_file_limit(least: int) -> None:
    """Raise the limit of open files for this process and its children.

    Raises:
        StereoSfmError: the system does not allow it.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < least:
        if hard != resource.RLIM_INFINITY and hard < least:
            raise StereoSfmError(f"only {hard} files may be open, a run needs {least}: raise 'ulimit -n', or --inline")
        resource.setrlimit(resource.RLIMIT_NOFILE, (least, hard))
