"""Child processes of the service: outputs and the recorder. Each has a pipe back to the service."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from typing import Any

from stereo_sfm.pipeline.fork_server import watched_start
from stereo_sfm.pipeline.interrupts import STOP_SIGNALS, ignored_by_children
from stereo_sfm.pipeline.text import LOGGER, Listener
from stereo_sfm.pipeline.threads import thread_environment
from stereo_sfm.pipeline.watchdog import HEARTBEAT_S, SILENT_S, Watchdog

log = logging.getLogger(LOGGER)

Send = Callable[[object], None]


def pipe() -> tuple[Connection, Connection]:
    """(receiving end, sending end)."""
    return multiprocessing.get_context("spawn").Pipe(duplex=False)


def start_child(
    name: str, body: Callable[..., None], *arguments: Any, context: SpawnContext | ForkServerContext | None = None
) -> BaseProcess:
    """Start a process; the ends of pipes among its arguments are closed here, so that its death is an end of file.

    Args: context, which has loaded what the body calls.
    """
    context = context or multiprocessing.get_context("spawn")
    with ignored_by_children(), thread_environment(1), watched_start():
        process = context.Process(target=body, args=arguments, name=name, daemon=True)
        process.start()
    for argument in arguments:
        if isinstance(argument, Connection):
            argument.close()
    return process


def follow(name: str, process: BaseProcess, reports: Connection, take: Callable[[object], None]) -> None:
    """Take the messages of a child until it ends. One that sends no heartbeat is killed, also while it starts.

    Only who has read everything may say that a child is silent: on a busy computer the service may be what is late.
    """
    assert process.pid is not None
    watchdog, checked_s = Watchdog({name: process.pid}, log.warning, SILENT_S), time.monotonic()
    with contextlib.suppress(EOFError, OSError):
        while True:
            if wait([reports], HEARTBEAT_S):
                message = reports.recv()
                watchdog.received(name, message)
                take(message)
            passed_s = time.monotonic() - checked_s
            checked_s += passed_s
            if passed_s > 2 * HEARTBEAT_S:  # this process stood still itself
                watchdog.excuse(passed_s)
            elif watchdog.silent([name]):
                process.kill()


def end_with_service() -> None:
    """In a child that reads no pipe: end the process when the service ends, however that happens."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def run_child(name: str, to_service: Connection, body: Callable[[Send], None]) -> None:
    """In the child: run its body with a function that sends to the service, then end the process.

    Stop signals are the service's to handle. Lines of the package's logger are sent as `LogLine`, with the name.
    """
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    lock = threading.Lock()

    def send(message: object) -> None:
        with lock, contextlib.suppress(OSError):
            to_service.send(message)

    logging.getLogger(LOGGER).setLevel(logging.INFO)
    with Listener(name, send):
        body(send)
    os._exit(0)  # a thread that waits for the disk may be left
