"""The process of an output: a queue to it that drops its oldest messages, and the commands that it calls."""

from __future__ import annotations

import contextlib
import importlib
import itertools
import logging
import pickle
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.messages import LogLine
from stereo_sfm.pipeline.channels import DroppingOutbox
from stereo_sfm.pipeline.text import LOGGER, emit
from stereo_sfm.pipeline.watchdog import HeartbeatThread
from stereo_sfm.service.child import Send, follow, pipe, run_child, start_child
from stereo_sfm.service.config import RobotConfig
from stereo_sfm.service.messages import ServiceMessage
from stereo_sfm.service.outputs import OUTPUTS, dds_memory
from stereo_sfm.service.publisher import Publisher, Reply

log = logging.getLogger(LOGGER)

LIMIT = 256  # messages that wait for an output
REOPEN_S = 5.0
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 30.0  # before a dead output is started again
STABLE_S = 60.0  # of running, after which the pause is short again
END_S = 1.0  # for an output to close

CommandHandler = Callable[[str, dict[str, Any]], Reply]


@dataclass(frozen=True)
class _Opened:
    """The output is open."""

    wants: frozenset[type]
    preview_hz: float


@dataclass(frozen=True)
class _Call:
    number: int
    name: str
    arguments: dict[str, Any]


@dataclass(frozen=True)
class _Replied:
    number: int
    reply: Reply


class OutputProcess:
    """One output: its process is started again when it dies."""

    def __init__(self, name: str, config: RobotConfig, handler: CommandHandler, module: str | None = None) -> None:
        """Args:
        name: of the output. config: of the whole service.
        handler: carries out a command, in any thread.
        module: "package.module:make" of the publisher; the table's when omitted.
        """
        self.name, self._config, self._handler = name, config, handler
        self._module = module or OUTPUTS[name]
        self._outbox: DroppingOutbox | None = None
        self._replies: DroppingOutbox | None = None
        self.wants: frozenset[type] = frozenset()
        self.preview_hz = 0.0
        self.starts = 0
        self._process: BaseProcess | None = None
        self._closing = threading.Event()
        self._pool = ThreadPoolExecutor(4, f"commands of {name}")
        self._thread = threading.Thread(target=self._supervise, name=f"output {name}", daemon=True)

    @property
    def pid(self) -> int | None:
        """Of the process, where it runs."""
        return None if self._process is None else self._process.pid

    def start(self) -> None:
        """Start the process, and start it again whenever it dies."""
        self._thread.start()

    def offer(self, kind: type[ServiceMessage], data: bytes) -> None:
        """Queue a pickled message of a kind, if the output wants it. Never blocks."""
        outbox = self._outbox
        if outbox is not None and kind in self.wants:
            outbox.send(data)

    def close(self) -> None:
        """Let the output close, and end it where it does not."""
        self._closing.set()
        if self._outbox is not None:
            self._outbox.close()
        if self.wants:  # else it is not open yet, and has nothing to close
            self._thread.join(END_S)
        if self._process is not None and self._thread.is_alive():
            self._process.kill()
        self._thread.join(END_S)
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _supervise(self) -> None:
        pause = FIRST_PAUSE_S
        while not self._closing.is_set():
            began = time.monotonic()
            self._run_once()
            if self._closing.is_set():
                return
            if time.monotonic() - began > STABLE_S:
                pause = FIRST_PAUSE_S
            code = self._process.exitcode if self._process is not None else None
            log.warning("the output %s ended (exit code %s); it is started again in %.0f s", self.name, code, pause)
            self._closing.wait(pause)
            pause = min(2 * pause, LONGEST_PAUSE_S)

    def _run_once(self) -> None:
        """Start the process and listen to it until it ends."""
        (messages, to_output), (reports, to_main), (replies, to_client) = (pipe() for _ in range(3))
        process = start_child(f"output {self.name}", run_output, self._module, self._config, messages, to_main, replies)
        self.starts += 1
        self._process, self._outbox = process, DroppingOutbox(to_output, LIMIT)
        self._replies = DroppingOutbox(to_client, LIMIT)
        if self._closing.is_set():  # `close` came while it was started, and has not seen it
            process.kill()
        follow(self.name, process, reports, self._take)
        self.wants = frozenset()
        reports.close()
        for outbox in (self._outbox, self._replies):
            outbox.close()
        process.join()
        if self.name == "ros2":
            dds_memory.sweep()

    def _take(self, message: object) -> None:
        if isinstance(message, _Opened):
            self.wants, self.preview_hz = message.wants, message.preview_hz
        elif isinstance(message, LogLine):
            emit(message)
        elif isinstance(message, _Call):
            self._pool.submit(self._carry_out, message)

    def _carry_out(self, call: _Call) -> None:
        reply = self._handler(call.name, call.arguments)
        if self._replies is not None:
            self._replies.send(_Replied(call.number, reply))


class PipeClient:
    """The service, in the process of an output."""

    def __init__(self, to_main: Callable[[object], None], replies: Connection) -> None:
        self._send, self._replies = to_main, replies
        self._numbers = itertools.count()
        self._waiting: dict[int, queue.SimpleQueue[Reply]] = {}
        self._over = False
        threading.Thread(target=self._listen, daemon=True).start()

    def call(self, name: str, timeout_s: float = 5.0, /, **arguments: Any) -> Reply:
        """See `ServiceClient`."""
        number, reply = next(self._numbers), queue.SimpleQueue[Reply]()
        self._waiting[number] = reply
        if not self._over:
            self._send(_Call(number, name, arguments))
        try:
            return reply.get(timeout=0.0 if self._over else timeout_s)
        except queue.Empty:
            why = "the service has ended" if self._over else f"the service did not reply within {timeout_s:g} s"
            return Reply(False, why)
        finally:
            self._waiting.pop(number, None)

    def _listen(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            while isinstance(message := self._replies.recv(), _Replied):
                reply = self._waiting.get(message.number)
                if reply is not None:
                    reply.put(message.reply)
        self._over = True
        for reply in list(self._waiting.values()):
            reply.put(Reply(False, "the service has ended"))


def run_output(
    module: str, config: RobotConfig, messages: Connection, to_main: Connection, replies: Connection
) -> None:
    """Body of the process of an output."""

    name = module.partition(":")[0].rpartition(".")[2]

    def body(send: Send) -> None:
        with HeartbeatThread(name, send):
            publish(send)

    def publish(send: Send) -> None:
        publisher = make_publisher(module, config)
        if not _open(publisher, PipeClient(send, replies), messages):
            return
        send(_Opened(publisher.wants, publisher.preview_hz))
        with contextlib.suppress(EOFError, OSError):
            while True:
                publisher.put(pickle.loads(messages.recv_bytes()))
        publisher.close()

    run_child(f"output {name}", to_main, body)


def make_publisher(module: str, config: RobotConfig) -> Publisher:
    """The publisher of an output, not yet open.

    Args:
        module: "package.module:make". config: of the whole service.

    Raises:
        StereoSfmError: what it needs is not installed, or its settings are invalid.
    """
    place, _, attribute = module.partition(":")
    return getattr(importlib.import_module(place), attribute)(config)


def _open(publisher: Publisher, client: PipeClient, messages: Connection) -> bool:
    """Open an output, trying again while it cannot be; False when the service ended before that."""
    said = ""
    while True:
        try:
            publisher.open(client)
            return True
        except StereoSfmError as error:
            if str(error) != said:
                log.warning("%s; trying again every %.0f s", error, REOPEN_S)
            said = str(error)
        if messages.poll(REOPEN_S):  # nothing is sent before it is open: this is the end
            return False
