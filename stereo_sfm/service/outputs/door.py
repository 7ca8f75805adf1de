"""A listening socket that those who only want to block it cannot block.

Connections are strangers until they have shown that they may be there. Strangers have few places and little time, by
the clock and not by what they send; when all places are taken, the peer that has most of them loses its oldest. Those
who are known have places of their own. A client that reads nothing is dropped by the system. Where clients speak
first, one that has said nothing costs its server nothing, and the peer that has fewest places is served first.
"""

from __future__ import annotations

import contextlib
import errno
import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

from stereo_sfm.service.outputs.peers import peer

STRANGERS, KNOWN = 32, 64  # places
HANDSHAKE_S = 5.0  # for TLS handshake, request and token together
IDLE_S = 15.0  # for the next request of one who is known
UNREAD_S = 10.0  # after which who does not read is dropped
SWEEP_S = 0.25  # between two looks at the clock
BACKLOG = 4096  # connections that the system holds until they are accepted; it may allow fewer
AT_ONCE = 64  # connections that are accepted before the next that has spoken is served


@dataclass(eq=False)
class Visit:
    """One connection.

    Attributes:
        socket: of the connection, or what replaced it. peer: who it is. address: as `getpeername` says.
        until: monotonic time at which it is ended. known: it has shown that it may be here.
    """

    socket: socket.socket
    peer: str
    address: tuple[Any, ...]
    until: float
    known: bool = False

    def end(self) -> None:
        """Disconnect; whoever uses the connection notices that as the client's end."""
        with contextlib.suppress(OSError):
            socket.socket.shutdown(self.socket, socket.SHUT_RDWR)  # not TLS's: another thread may be reading


class _Connection(socket.socket):
    """A connection that leaves its door when it is closed."""

    left: Callable[[], None] | None = None

    def close(self) -> None:
        super().close()
        if self.left is not None:
            self.left()


class Door(socket.socket):
    """A listening socket whose `accept` gives connections that are counted until they are closed."""

    @classmethod
    def of(
        cls,
        listening: socket.socket,
        known: int = KNOWN,
        handshake_s: float | None = None,
        peer_of: Callable[[socket.socket], str] = peer,
        speak: bool = False,
    ) -> Self:
        """A door in place of a listening socket.

        Args:
        known: places for those who are known.
        handshake_s: for strangers; None: HANDSHAKE_S.
        peer_of: names a connection's peer.
        speak: clients speak first; those who have said nothing wait in the door.
        """
        door = cls(listening.family, listening.type, listening.proto, fileno=listening.detach())
        door._places, door._peer_of = known, peer_of
        door._handshake_s = HANDSHAKE_S if handshake_s is None else handshake_s
        door._visits, door._silent = dict[Visit, None](), dict[int, Visit]()
        door._kind = door.family, door.type, door.proto
        door._events = None
        if speak:
            door.setblocking(False)
            door._events = select.epoll()
            door._events.register(socket.socket.fileno(door), select.EPOLLIN)
        door._lock = threading.RLock()
        door._closed_now = threading.Event()
        threading.Thread(target=door._sweep, name="door", daemon=True).start()
        return door

    _places: int
    _handshake_s: float
    _peer_of: Callable[[socket.socket], str]
    _visits: dict[Visit, None]  # the oldest first
    _silent: dict[int, Visit]  # by the number of its socket
    _kind: tuple[int, int, int]
    _events: select.epoll | None  # of itself, and of those who have said nothing
    _lock: threading.RLock
    _closed_now: threading.Event

    def fileno(self) -> int:
        """What tells that `accept` may have a connection."""
        number = super().fileno()
        return number if self._events is None or number < 0 else self._events.fileno()

    def listen(self, backlog: int = BACKLOG, /) -> None:
        """It listens already; a server's own backlog changes nothing."""

    def accept(self) -> tuple[socket.socket, Any]:
        """A connection and its address, as of any socket; where clients speak first, of one that does not block.

        Raises:
            OSError: as of `socket.accept`.
        """
        visit = self.visitor() if self._events is None else self._heard(self._events, 0.0)
        if visit is None:
            raise BlockingIOError(errno.EAGAIN, "nobody has spoken")
        return visit.socket, visit.address

    def visitor(self) -> Visit:
        """The next connection.

        Raises:
            OSError: as of `socket.accept`.
        """
        while not self._closed_now.is_set():
            visit = self._enter() if self._events is None else self._heard(self._events, SWEEP_S)
            if visit is not None:
                return visit
        raise OSError(errno.EBADF, "the door is closed")

    def _enter(self) -> Visit | None:
        """Accept one connection; None where it is gone already."""
        plain, address = super().accept()
        connection = _Connection(*self._kind, fileno=plain.detach())
        try:
            name = self._peer_of(connection)
            if connection.family != socket.AF_UNIX:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(UNREAD_S * 1e3))
        except (OSError, ValueError):
            connection.close()
            return None
        visit = Visit(connection, name, address, time.monotonic() + self._handshake_s)
        connection.left = lambda: self.leave(visit)
        with self._lock:
            if self._events is not None:
                self._silent[connection.fileno()] = visit
                self._events.register(connection, select.EPOLLIN)
            self._add(visit)
        return visit

    def _heard(self, events: select.epoll, seconds: float) -> Visit | None:
        """Let in who comes; one who has spoken, of the peer that has fewest places; None where nobody has."""
        ready, listening = events.poll(seconds), super().fileno()
        if listening in dict(ready):
            with contextlib.suppress(BlockingIOError):
                for _ in range(AT_ONCE):
                    self._enter()
            ready = events.poll(0.0)
        with self._lock:
            places = Counter(v.peer for v in self._visits if not v.known)
            spoken = [self._silent[number] for number, _ in ready if number in self._silent]
            for visit in sorted(spoken, key=lambda v: places[v.peer]):
                if _has_spoken(visit.socket):
                    events.unregister(visit.socket)
                    del self._silent[visit.socket.fileno()]
                    return visit
                self._drop(visit)
        return None

    def _add(self, visit: Visit) -> None:
        with self._lock:
            self._visits[visit] = None
            strangers = [v for v in self._visits if not v.known]
            if len(strangers) > STRANGERS:
                most = Counter(v.peer for v in strangers).most_common(1)[0][0]
                self._drop(next(v for v in strangers if v.peer == most))

    def _drop(self, visit: Visit) -> None:
        self._visits.pop(visit, None)
        if self._silent.get(number := visit.socket.fileno()) is visit:
            del self._silent[number]
            visit.socket.close()  # nobody else has it
        else:
            visit.end()

    def leave(self, visit: Visit) -> None:
        """It is closed."""
        with self._lock:
            self._visits.pop(visit, None)

    def visit(self, address: tuple[Any, ...] | None) -> Visit | None:
        """The connection from an address (host, port); None if it is no longer there."""
        with self._lock:
            return next((v for v in self._visits if address is not None and v.address[:2] == tuple(address[:2])), None)

    def welcome(self, visit: Visit) -> bool:
        """It has shown that it may be here, and may stay until `rest`; False where all places are taken."""
        with self._lock:
            if not visit.known and (visit not in self._visits or self.known >= self._places):
                return False
            visit.known, visit.until = True, float("inf")
            return True

    def rest(self, visit: Visit, seconds: float = IDLE_S) -> None:
        """What one who is known asked for is done."""
        if visit.known:
            visit.until = time.monotonic() + seconds

    @property
    def known(self) -> int:
        """How many are connected that may be."""
        with self._lock:
            return sum(v.known for v in self._visits)

    def close(self) -> None:
        self._closed_now.set()
        super().close()
        with self._lock:
            for visit in list(self._silent.values()):
                self._drop(visit)

    def _sweep(self) -> None:
        while not self._closed_now.wait(SWEEP_S):
            now = time.monotonic()
            with self._lock:
                for visit in [v for v in self._visits if v.until <= now]:
                    self._drop(visit)


def _has_spoken(connection: socket.socket) -> bool:
    """Whether there is something to read; not its end."""
    try:
        return bool(connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT))
    except OSError:
        return False
