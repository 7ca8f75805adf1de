"""One-way pipes between two processes: one writer, one reader, and no lock that a killed process could hold."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class End:
    """The stage has sent its last message."""

    stage: str
    early: bool = False  # another stage died: its last messages are missing


@dataclass(frozen=True)
class Failed:
    """The stage ended with an error."""

    stage: str
    message: str  # one line for a StereoSfmError, else the traceback
    ours: bool
    exit_code: int


class Lost(Exception):
    """The process at the other end has ended."""


class Outbox:
    """Sends in a thread, so that two stages that write to each other never wait for one another's pipe.

    At most `limit` messages wait; then `send` blocks, which is the back-pressure of the pipeline. 0: any number.
    """

    def __init__(self, connection: Connection, limit: int = 64) -> None:
        self._connection = connection
        self._queue: queue.Queue[Any] = queue.Queue(limit)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def send(self, message: object) -> None:
        """Queue a message."""
        self._queue.put((message,))

    def offer(self, message: object, patience_s: float) -> bool:
        """Queue a message; False if there was no room for it within so many seconds."""
        try:
            self._queue.put((message,), timeout=patience_s)
        except queue.Full:
            return False
        return True

    def waiting(self) -> int:
        """Messages not yet in the pipe."""
        return self._queue.qsize()

    def close(self) -> None:
        """Send what waits, then close the pipe."""
        self._queue.put(None)
        self._thread.join()
        self._connection.close()

    def _work(self) -> None:
        gone = False
        while (item := self._queue.get()) is not None:
            if not gone:
                try:
                    self._connection.send(item[0])
                except OSError:
                    gone = True  # the reader died: main ends the run; nobody waits for these messages


class DroppingOutbox:
    """As `Outbox`, but `send` never blocks: when too many wait, the oldest is dropped (a slow or closed viewer)."""

    def __init__(
        self,
        connection: Connection,
        limit: int = 256,
        write: Callable[[Connection, Any], None] = Connection.send,
    ) -> None:
        """Args: limit, most messages that wait; write, puts one into the pipe (`Connection.send_bytes` for bytes)."""
        self._connection, self._write = connection, write
        self._waiting: deque[object] = deque(maxlen=limit)
        self._more = threading.Semaphore(0)
        self._closing = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def send(self, message: object) -> None:
        """Queue a message, which may be dropped later."""
        self._waiting.append(message)
        self._more.release()

    def close(self) -> None:
        """Send what waits, then close the pipe, without waiting for it."""
        self._closing = True
        self._more.release()

    def _work(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                self._more.acquire()
                if self._waiting:
                    self._write(self._connection, self._waiting.popleft())
                elif self._closing:
                    break
        self._connection.close()


class Inbox(Generic[T]):
    """Receiving end; `take` blocks."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection

    def take(self) -> T:
        """The next message.

        Raises:
            Lost: the sender has ended.
        """
        try:
            return self.connection.recv()
        except (EOFError, OSError):
            raise Lost from None

    def ready(self) -> bool:
        """Whether a message is there: only the realtime schedule asks."""
        return self.connection.poll(0)
