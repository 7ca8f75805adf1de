"""One-way pipes between two processes: one writer, one reader, and no lock that a killed process could hold."""

from __future__ import annotations

import contextlib
import functools
import queue
import selectors
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

    A message of bytes is one that is pickled already.

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
        closed = False
        while (item := self._queue.get()) is not None:
            if not closed:
                try:
                    (self._connection.send_bytes if isinstance(item[0], bytes) else self._connection.send)(item[0])
                except OSError:
                    closed = True  # the reader died: main ends the run, and nothing waits for these messages


class DroppingQueue(Generic[T]):
    """Messages for a handler in a thread of its own: `put` never blocks, the oldest are dropped when too many wait."""

    def __init__(self, handle: Callable[[T], object], limit: int, name: str | None = None) -> None:
        """Args: handle, takes one message after the other; limit, most messages that wait; name, of the thread."""
        self._handle = handle
        self._waiting: deque[T] = deque(maxlen=limit)
        self._more = threading.Semaphore(0)
        self._closing = False
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def put(self, message: T) -> None:
        """Queue a message, which may be dropped later."""
        self._waiting.append(message)
        self._more.release()

    def close(self) -> None:
        """End after the messages that wait; returns at once."""
        self._closing = True
        self._more.release()

    def join(self, timeout_s: float) -> bool:
        """After `close`: wait for the handler; False if it is still busy, or this is its own thread."""
        if self._thread is not threading.current_thread():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _work(self) -> None:
        while True:
            self._more.acquire()
            if self._waiting:
                self._handle(self._waiting.popleft())
            elif self._closing:
                return


class DroppingOutbox(DroppingQueue[object]):
    """As `Outbox`, but sending never blocks: when too many messages wait, the oldest is dropped (a slow viewer)."""

    def __init__(
        self,
        connection: Connection,
        limit: int = 256,
        write: Callable[[Connection, Any], None] = Connection.send,
    ) -> None:
        """Args: write, puts a message into the pipe (`Connection.send_bytes` for bytes); others as `DroppingQueue`."""
        self._connection = connection
        super().__init__(functools.partial(write, connection), limit)

    def send(self, message: object) -> None:
        """Queue a message, which may be dropped later."""
        self.put(message)

    def _work(self) -> None:
        with contextlib.suppress(OSError):  # the reader has ended
            super()._work()
        self._connection.close()


class Arrivals:
    """As `multiprocessing.connection.wait`, which registers all connections in each call, but they stay registered."""

    def __init__(self) -> None:
        self._connections: list[Connection] = []
        self._selector = selectors.PollSelector()

    def wait(self, connections: list[Connection], timeout_s: float) -> list[Connection]:
        """Those of the connections that have a message or have ended, after at most so many seconds."""
        if connections != self._connections:
            self._selector.close()
            self._selector = selectors.PollSelector()
            for connection in connections:
                self._selector.register(connection, selectors.EVENT_READ)
            self._connections = connections
        return [key.fileobj for key, _ in self._selector.select(timeout_s)]  # pyright: ignore[reportReturnType]


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
        """Whether a message is there: for the realtime schedule."""
        return self.connection.poll(0)


class PrefetchingInbox(Generic[T]):
    """As `Inbox`, but a thread receives: `take` after `ready` does not wait for the rest of a long message.

    A pipe holds 64 KiB. The sender's thread fills it again only when its process lets it run, which one that computes
    does every few milliseconds at best.
    """

    def __init__(self, connection: Connection) -> None:
        self._inbox: Inbox[T] = Inbox(connection)
        self._arrived: queue.SimpleQueue[T | Lost] = queue.SimpleQueue()
        threading.Thread(target=self._work, daemon=True).start()

    def take(self) -> T:
        """The next message.

        Raises:
            Lost: the sender has ended.
        """
        message = self._arrived.get()
        if isinstance(message, Lost):
            self._arrived.put(message)
            raise message
        return message

    def ready(self) -> bool:
        """Whether a whole message is there."""
        return not self._arrived.empty()

    def _work(self) -> None:
        try:
            while True:
                self._arrived.put(self._inbox.take())
        except Lost as lost:
            self._arrived.put(lost)
