"""One-way pipes between two processes: one writer, one reader, and no lock that a killed process could hold."""

from __future__ import annotations

import contextlib
import fcntl
import os
import queue
import selectors
import struct
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Generic, TypeVar

T = TypeVar("T")

PIPE_BYTES = 1 << 18  # of a pipe: several keyframes; the default is less than one


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
    """Sends without waiting for the reader, so that two stages that write to each other never wait for one another.

    A message goes into the pipe at once where there is room for it, else a thread sends it: to wake a thread for every
    message, which takes the interpreter from the one that computes, would cost more than to send it. A message of bytes
    is one that is pickled already.

    At most `limit` messages wait; then `send` blocks, which is the back-pressure of the pipeline. 0: any number.
    """

    def __init__(self, connection: Connection, limit: int = 64) -> None:
        self._connection, self._descriptor = connection, connection.fileno()
        os.set_blocking(self._descriptor, False)
        _enlarge(self._descriptor)
        self._sending = threading.Lock()  # one message after the other
        self._queue: queue.Queue[memoryview | None] = queue.Queue(limit)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def send(self, message: object) -> None:
        """Send a message, or queue it."""
        with self._sending:
            rest = self._attempt(_framed(message))
            if rest:
                self._queue.put(rest)

    def offer(self, message: object, patience_s: float) -> bool:
        """Send or queue a message; False if there was no room for it within so many seconds."""
        with self._sending:
            rest = self._attempt(_framed(message))
            try:
                if rest:
                    self._queue.put(rest, timeout=patience_s)
            except queue.Full:
                return False
            return True

    def waiting(self) -> int:
        """Messages not yet in the pipe."""
        return self._queue.qsize()

    def close(self) -> None:
        """Send what waits, then close the pipe; what is sent later is dropped."""
        self._queue.put(None)
        self._thread.join()
        with self._sending:
            self._descriptor = -1  # the number may be another file's soon
            self._connection.close()

    def _attempt(self, data: memoryview) -> memoryview:
        """Put as much of a message into the pipe as there is room for, unless others wait; returns the rest."""
        return data if self._queue.unfinished_tasks else _put(self._descriptor, data)

    def _work(self) -> None:
        room = selectors.PollSelector()
        room.register(self._descriptor, selectors.EVENT_WRITE)
        while (rest := self._queue.get()) is not None:
            while rest := _put(self._descriptor, rest):
                room.select()
            self._queue.task_done()
        self._queue.task_done()
        room.close()


def pickled(message: object) -> bytes:
    """A message that goes to several readers, as `Outbox.send` takes it."""
    return bytes(ForkingPickler.dumps(message))


def _framed(message: object) -> memoryview:
    """A message as `Connection.recv` expects it (multiprocessing.connection, `_send_bytes`)."""
    data = message if isinstance(message, bytes) else ForkingPickler.dumps(message)
    size = len(data)
    header = struct.pack("!i", size) if size < 1 << 31 else struct.pack("!iQ", -1, size)
    return memoryview(b"".join((header, data)))


def _put(descriptor: int, data: memoryview) -> memoryview:
    """Put as much into a pipe as there is room for; returns the rest, which is empty if nobody reads any more."""
    try:
        return data[os.write(descriptor, data) :]
    except BlockingIOError:
        return data
    except OSError:  # the reader died, which its watcher handles
        return data[0:0]


def _enlarge(descriptor: int) -> None:
    """Give a pipe room for some messages, where the system allows it."""
    with contextlib.suppress(OSError, AttributeError):
        fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, PIPE_BYTES)


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

    def __init__(self, connection: Connection, limit: int = 256) -> None:
        self._connection, self._descriptor = connection, connection.fileno()
        os.set_blocking(self._descriptor, False)
        self._writing = threading.Lock()
        self._rest = memoryview(b"")  # of a message that is partly in the pipe
        super().__init__(_framed, limit)

    def send(self, message: object) -> None:
        """Send a message where there is room and none waits, else queue it: it may be dropped later."""
        with self._writing:
            at_once = not self._waiting and not self._rest
            if at_once:
                self._rest = _put(self._descriptor, _framed(message))
        if not at_once:
            self.put(message)
        elif self._rest:
            self._more.release()  # the thread sends what is left of it

    def _work(self) -> None:
        room = selectors.PollSelector()
        room.register(self._descriptor, selectors.EVENT_WRITE)
        while not self._closing or self._waiting or self._rest:
            self._more.acquire()
            while self._next():
                room.select()
        room.close()
        with self._writing:
            self._descriptor = -1  # the number may be another file's soon
            self._connection.close()

    def _next(self) -> bool:
        """Write what waits as long as there is room; whether some is left."""
        with self._writing:
            while self._rest or self._waiting:
                self._rest = _put(self._descriptor, self._rest or _framed(self._waiting.popleft()))
                if self._rest:
                    return True
        return False


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
