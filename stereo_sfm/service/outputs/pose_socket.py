"""Poses on a socket: one message a pose to every client that is connected.

A client that does not read misses poses and delays no other. Its next message has the number of poses it missed. One
that reads nothing for ten seconds is dropped.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import stat
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from ssl import SSLWantReadError, SSLWantWriteError
from typing import TYPE_CHECKING

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.messages import PoseUpdate, ServiceMessage, Started
from stereo_sfm.service.outputs.access import Access, TooManyAttempts, access
from stereo_sfm.service.outputs.door import BACKLOG, UNREAD_S, Door, Visit
from stereo_sfm.service.outputs.pose_message import FORMATS, pose_message
from stereo_sfm.service.outputs.robot_axes import RobotAxes
from stereo_sfm.service.publisher import ServiceClient

if TYPE_CHECKING:
    from stereo_sfm.service.config import RobotConfig

log = logging.getLogger("stereo_sfm")

MOST_CLIENTS = 32
BUFFER_BYTES = 1 << 16  # of the system for one client: a slow one is not far behind
HTTP = " HTTP/1.0", " HTTP/1.1"  # how the first line of a request ends
HANDSHAKE_BYTES = 4200
SOCKET_MODE = 0o660
AGAIN_S = 0.1  # until the next connection is accepted where the system refused one


def make(config: RobotConfig) -> PoseSocket:
    """The output."""
    section = config.outputs.pose_socket
    place = Place.read(section.address)
    rules = access(config.security, place.host) if place.host else Access()
    return PoseSocket(place, section.format, rules)


@dataclass(frozen=True)
class Place:
    """Where to listen: a port of an address, or a local socket."""

    host: str = ""
    port: int = 0
    path: Path | None = None

    @staticmethod
    def read(text: str) -> Place:
        """`tcp://ADDRESS:PORT`, or a path with a slash.

        Raises:
            StereoSfmError: neither.
        """
        if not text.startswith("tcp://"):
            host, _, port = text.rpartition(":")
            if "/" not in text and port.isdigit():
                raise StereoSfmError(f"pose socket '{text}': did you mean tcp://{host or '127.0.0.1'}:{port}?")
            if "/" not in text or "://" in text:
                raise StereoSfmError(f"pose socket '{text}': give tcp://127.0.0.1:7000, or a path such as ./{text}")
            return Place(path=Path(text).expanduser())
        host, _, port = text.removeprefix("tcp://").rpartition(":")
        if not host or not port.isdigit() or not 0 <= int(port) <= 65535:
            raise StereoSfmError(f"pose socket '{text}': give an address and a port, such as tcp://127.0.0.1:7000")
        return Place(host.strip("[]"), int(port))

    def listen(self) -> socket.socket:
        """A listening socket.

        Raises:
            StereoSfmError: the place is taken, or not ours.
        """
        try:
            return self._local() if self.path is not None else self._tcp()
        except (OSError, UnicodeError) as error:
            why = getattr(error, "strerror", None) or error
            raise StereoSfmError(f"pose socket: cannot listen on {self}: {why}") from None

    def _tcp(self) -> socket.socket:
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        return socket.create_server((self.host, self.port), family=family, backlog=BACKLOG)

    def _local(self) -> socket.socket:
        assert self.path is not None
        if self.path.exists() and stat.S_ISSOCK(self.path.stat().st_mode) and not _is_listening(self.path):
            self.path.unlink()  # left by a process that was killed
        server = socket.socket(socket.AF_UNIX)
        server.bind(str(self.path))
        self.path.chmod(SOCKET_MODE)
        server.listen(BACKLOG)
        return server

    def __str__(self) -> str:
        return str(self.path) if self.path is not None else f"tcp://{self.host}:{self.port}"


def _is_listening(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        return probe.connect_ex(str(path)) == 0


class _Client:
    """One connection: what the system has not taken yet, and how many poses were left out because of that."""

    def __init__(self, visit: Visit) -> None:
        self.visit, self.connection = visit, visit.socket
        self.pending = b""
        self.missed = 0
        self._read_s = time.monotonic()  # when the system last had taken all

    def flush(self) -> bool:
        """Give the system what waits; False where it has no room.

        Raises:
            OSError: the client has disconnected, or has read nothing for too long.
        """
        try:
            while self.pending:
                self.pending = self.pending[self.connection.send(self.pending) :]
            self._read_s = time.monotonic()
        except (BlockingIOError, InterruptedError, SSLWantReadError, SSLWantWriteError):
            if time.monotonic() - self._read_s > UNREAD_S:
                raise TimeoutError("the client does not read") from None
            return False
        return True


class PoseSocket:
    """The publisher of poses on a socket."""

    wants: frozenset[type[ServiceMessage]] = frozenset({Started, PoseUpdate})
    preview_hz = 0.0

    def __init__(self, place: Place, form: str, rules: Access | None = None) -> None:
        """Args: place, where to listen. form: a key of FORMATS. rules: for those who connect."""
        self._place, self._format, self._rules = place, FORMATS[form](), rules or Access()
        self._server: Door | None = None
        self._clients: list[_Client] = []
        self._lock = threading.Lock()
        self._axes: RobotAxes | None = None

    @property
    def port(self) -> int:
        """The port, where it listens on one."""
        return 0 if self._server is None or self._place.path is not None else self._server.getsockname()[1]

    def open(self, service: ServiceClient) -> None:
        """Listen."""
        self._server = Door.of(self._place.listen(), MOST_CLIENTS, speak=bool(self._rules.token))
        threading.Thread(target=self._accept, args=(self._server,), daemon=True).start()

    def put(self, message: ServiceMessage) -> None:
        """Send a pose to those who have room for it."""
        if isinstance(message, Started):
            self._axes = RobotAxes(message.rig)
        elif isinstance(message, PoseUpdate) and self._axes is not None:
            with self._lock:
                clients = list(self._clients)
            if clients:
                self._send(self._format.body(pose_message(message, self._axes)), clients)

    def close(self) -> None:
        """Close all connections."""
        if self._server is not None:
            self._server.close()
        for client in self._clients:
            client.connection.close()
        if self._place.path is not None:
            self._place.path.unlink(missing_ok=True)

    def _send(self, body: bytes, clients: list[_Client]) -> None:
        for client in clients:
            try:
                if not client.flush():
                    client.missed += 1
                    continue
                client.pending, client.missed = self._format.framed(body, client.missed), 0
                client.flush()
            except OSError:
                self._drop(client)

    def _drop(self, client: _Client) -> None:
        self._leave(client.visit)
        with self._lock:
            self._clients.remove(client)

    def _leave(self, visit: Visit) -> None:
        visit.socket.close()
        if self._server is not None:
            self._server.leave(visit)

    def _accept(self, door: Door) -> None:
        while door.fileno() >= 0:
            try:
                visit = door.visitor()
            except OSError:  # it is closed, or there are too many open files
                time.sleep(AGAIN_S)
                continue
            if self._rules.token or self._rules.tls is not None:
                threading.Thread(target=self._authenticate, args=(door, visit), daemon=True).start()
            else:  # nothing to wait for
                self._authenticate(door, visit)

    def _authenticate(self, door: Door, visit: Visit) -> None:
        """TLS handshake and token, where they are needed; then the client gets poses."""
        known = False
        with contextlib.suppress(OSError, UnicodeError, TooManyAttempts):
            if self._rules.tls is not None:
                visit.socket = tls = self._rules.tls.wrap_socket(
                    visit.socket, server_side=True, do_handshake_on_connect=False
                )
                tls.do_handshake()
            known = not self._rules.token
            if not known:
                line = _first_line(visit.socket)  # a page's request is no attempt: it must not lock out its visitor
                known = not line.endswith(HTTP) and self._rules.allows(line, visit.peer)
            known = known and door.welcome(visit)
            if known:
                _make_streaming(visit.socket)
        if not known:
            self._leave(visit)
            return
        with self._lock:
            self._clients.append(_Client(visit))


def _make_streaming(connection: socket.socket) -> None:
    """A connection that never blocks and does not keep old poses."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
    if connection.family != socket.AF_UNIX:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setblocking(False)


def _first_line(connection: socket.socket) -> str:
    data = b""
    while b"\n" not in data and len(data) < HANDSHAKE_BYTES:
        more = connection.recv(HANDSHAKE_BYTES - len(data))
        if not more:
            break
        data += more
    return data.partition(b"\n")[0].decode("ascii").strip()
