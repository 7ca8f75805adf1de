"""How the processes of a run are started: forked from a process that has loaded their code and started no thread, where
possible. They share its memory, and none takes a second to load the same code."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import ForkServerContext, SpawnContext

from stereo_sfm.pipeline.interrupts import ignored_by_children
from stereo_sfm.pipeline.text import LOGGER
from stereo_sfm.pipeline.threads import thread_environment
from stereo_sfm.pipeline.watchdog import HEARTBEAT_S, SILENT_S, STOPPED, process_state

log = logging.getLogger(LOGGER)


def start_context(threads: int) -> SpawnContext | ForkServerContext:
    """A context in which stages may be started; the process that they are forked from begins to load their code.

    Args: threads, that numeric libraries may use in each process.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["stereo_sfm.pipeline.preload"])
    with ignored_by_children(), thread_environment(threads):
        forkserver.ensure_running()
    return context


@contextmanager
def watched_start() -> Generator[None]:
    """While a stage is started: where the process that it is forked from was stopped, it is continued, else killed.

    Main waits for that process, and nothing else would end the wait.
    """
    over = threading.Event()
    watcher = threading.Thread(target=_watch, args=(over,), name="fork server", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()


def _watch(over: threading.Event) -> None:
    stopped_s, signals = 0.0, iter((signal.SIGCONT, signal.SIGKILL))
    while not over.wait(HEARTBEAT_S):
        pid = _helpers()[0]
        stopped = pid is not None and process_state(pid) in STOPPED
        stopped_s = stopped_s + HEARTBEAT_S if stopped else 0.0
        if pid is None or stopped_s <= SILENT_S:
            continue
        number = next(signals, signal.SIGKILL)
        what = "continued" if number == signal.SIGCONT else "killed"
        log.warning("the process that starts the stages was stopped by a signal: it is %s", what)
        with contextlib.suppress(OSError):
            os.kill(pid, number)
        stopped_s = 0.0


def kill_fork_server() -> None:
    """Whoever waits for it gets an end of file; the next start begins another one."""
    pid = _helpers()[0]
    if pid is not None:
        with contextlib.suppress(OSError):
            os.kill(pid, signal.SIGKILL)


def resume_helpers() -> None:
    """Let the processes of multiprocessing go on that a signal has stopped: they could not end with this one."""
    for pid in _helpers():
        if pid is not None:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGCONT)


def _helpers() -> tuple[int | None, int | None]:
    """Process ids of the fork server and of the tracker of shared memory, which multiprocessing does not tell."""
    server = getattr(forkserver, "_forkserver", None)
    tracker = getattr(resource_tracker, "_resource_tracker", None)
    return getattr(server, "_forkserver_pid", None), getattr(tracker, "_pid", None)
