"""Attacks on ports: connections that only take places, send slowly or do not read; the known are not shut out."""

from __future__ import annotations

import http.client
import json
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest

from stereo_sfm.service.outputs import door
from stereo_sfm.service.outputs.access import Access
from stereo_sfm.service.outputs.door import STRANGERS, Door, Visit
from stereo_sfm.service.outputs.pose_socket import Place, PoseSocket
from stereo_sfm.service.page.server import PageOutput
from tests.service.service_messages import FakeService, pose_update, started

TOKEN = "a-token-of-thirty-two-characters"
BEARER = {"Authorization": f"Bearer {TOKEN}"}


def _by_source(connection: socket.socket) -> str:
    """Every address of 127.0.0.0/8 as a peer of its own, as if it were another computer."""
    return str(connection.getpeername()[0])


@contextmanager
def _door(known: int = 4, handshake_s: float = 5.0, speak: bool = False) -> Iterator[Door]:
    made = Door.of(socket.create_server(("127.0.0.1", 0)), known, handshake_s, _by_source, speak)
    try:
        yield made
    finally:
        made.close()


def _connect(port: int, source: str = "127.0.0.1") -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), 5, source_address=(source, 0))


def _is_closed(client: socket.socket, seconds: float = 3.0) -> bool:
    client.settimeout(seconds)
    try:
        return client.recv(1) == b""
    except ConnectionError:
        return True
    except TimeoutError:
        return False


def _drip(client: socket.socket, count: int) -> None:
    """One byte after the other, until the connection is closed."""
    with suppress(ConnectionError):
        for _ in range(count):
            client.sendall(b"x")
            time.sleep(0.1)


def _until(true: Callable[[], bool], seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.005)


def test_a_crowd_of_strangers_loses_its_own_places_first() -> None:
    with _door() as server, ExitStack() as open_ones:
        port = server.getsockname()[1]
        lonely = open_ones.enter_context(_connect(port, "127.0.0.2"))
        server.visitor()
        crowd = [open_ones.enter_context(_connect(port, "127.0.0.3")) for _ in range(STRANGERS + 20)]
        visits = [server.visitor() for _ in crowd]
        assert sum(_is_closed(client, 0.05) for client in crowd) == 21  # one place is taken by the other one
        assert _is_closed(crowd[0], 0.1) and not _is_closed(crowd[-1], 0.1) and not _is_closed(lonely, 0.1)
        for visit in visits:
            visit.socket.close()


def test_who_is_known_has_places_of_its_own() -> None:
    with _door(known=2) as server, ExitStack() as open_ones:
        port = server.getsockname()[1]
        clients = [open_ones.enter_context(_connect(port)) for _ in range(STRANGERS)]
        visits = [server.visitor() for _ in clients]
        assert server.welcome(visits[0]) and server.welcome(visits[1]) and not server.welcome(visits[2])
        for _ in range(STRANGERS + 5):
            open_ones.enter_context(_connect(port))
            visits.append(server.visitor())
        assert not _is_closed(clients[0], 0.1) and not _is_closed(clients[1], 0.1) and _is_closed(clients[2], 0.1)
        visits[0].socket.close()
        assert server.known == 1 and server.welcome(visits[-1])
        for visit in visits:
            visit.socket.close()


def test_time_counts_and_not_what_is_sent() -> None:
    """One byte after the other keeps no connection open; nor does one who is known, when it asks for nothing."""
    with _door(handshake_s=0.6) as server, _connect(server.getsockname()[1]) as client:
        visit = server.visitor()
        begin = time.monotonic()
        _drip(client, 50)
        assert 0.5 < time.monotonic() - begin < 2.0
        visit.socket.close()
        with _connect(server.getsockname()[1]) as known:
            visit = server.visitor()
            assert server.welcome(visit) and not _is_closed(known, 1.0)
            server.rest(visit, 0.1)
            assert _is_closed(known)
            visit.socket.close()


def test_who_comes_alone_is_served_before_a_crowd() -> None:
    with _door(speak=True) as server, ExitStack() as open_ones:
        port = server.getsockname()[1]
        sources = ["127.0.0.3"] * (STRANGERS // 2) + ["127.0.0.2"] + ["127.0.0.3"] * (STRANGERS // 2 - 1)
        for source in sources:  # none has to leave
            open_ones.enter_context(_connect(port, source)).sendall(b"x")
        visits = [server.visitor() for _ in sources]
        assert [visit.peer for visit in visits] == sorted(sources)
        for visit in visits:
            visit.socket.close()


def test_a_door_keeps_those_who_say_nothing() -> None:
    """They leave it when their time is over, when they end, or with the door, and nobody else sees them."""
    with _door(handshake_s=0.6, speak=True) as server, ExitStack() as open_ones:
        port = server.getsockname()[1]
        for _ in range(10):
            _connect(port).close()
        with pytest.raises(BlockingIOError):
            server.accept()
        assert not server._visits  # pyright: ignore[reportPrivateUsage]
        silent = open_ones.enter_context(_connect(port))
        with pytest.raises(BlockingIOError):
            server.accept()
        assert len(server._visits) == 1 and _is_closed(silent)  # pyright: ignore[reportPrivateUsage]
    with _door(speak=True) as server, _connect(server.getsockname()[1]) as silent:
        with pytest.raises(BlockingIOError):
            server.accept()
        server.close()
        assert _is_closed(silent) and server.fileno() == -1
        with pytest.raises(OSError, match="closed"):
            server.visitor()


def test_a_crowd_that_says_nothing_costs_the_page_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """None of it reaches the web server, and the system may hold many: a longer queue loses fewer."""
    given, accept = list[object](), Door.accept

    def counted(self: Door) -> tuple[socket.socket, object]:
        given.append(found := accept(self))
        return found

    monkeypatch.setattr(Door, "accept", counted)
    output = PageOutput("127.0.0.1", 0, 4.0, Access(TOKEN))
    output.open(FakeService())
    try:
        with ExitStack() as crowd:
            for _ in range(3 * STRANGERS):
                crowd.enter_context(_connect(output.port))
            connection = http.client.HTTPConnection("127.0.0.1", output.port, timeout=5)
            connection.request("GET", "/api/map", headers=BEARER)
            assert connection.getresponse().status == 200 and len(given) == 1
            connection.close()
        web = output._web.door  # pyright: ignore[reportPrivateUsage]
        assert web is not None and _queue(web) == _allowed(door.BACKLOG)
    finally:
        output.close()


def test_a_crowd_that_says_nothing_costs_the_pose_socket_no_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, authenticate = list[Visit](), PoseSocket._authenticate  # pyright: ignore[reportPrivateUsage]

    def counted(self: PoseSocket, server: Door, visit: Visit) -> None:
        begun.append(visit)
        authenticate(self, server, visit)

    monkeypatch.setattr(PoseSocket, "_authenticate", counted)
    output = PoseSocket(Place.read("tcp://127.0.0.1:0"), "json", Access(TOKEN))
    output.open(FakeService())
    try:
        with ExitStack() as crowd:
            for _ in range(3 * STRANGERS):
                crowd.enter_context(_connect(output.port))
            with _connect(output.port) as client:
                client.sendall(TOKEN.encode() + b"\n")
                _until(lambda: bool(output._clients))  # pyright: ignore[reportPrivateUsage]
                assert len(begun) == 1
        server = output._server  # pyright: ignore[reportPrivateUsage]
        assert server is not None and _queue(server) == _allowed(door.BACKLOG)
    finally:
        output.close()


def _queue(listening: socket.socket) -> int:
    """Connections that the system holds for a listening socket."""
    info = listening.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 32)
    return int(struct.unpack_from("I", info, 28)[0])  # tcpi_sacked, of a socket that listens


def _allowed(backlog: int) -> int:
    return min(backlog, int(Path("/proc/sys/net/core/somaxconn").read_text()))


@pytest.mark.parametrize("rules", [Access(TOKEN), Access()])
def test_idle_connections_do_not_close_the_page(rules: Access) -> None:
    output = PageOutput("127.0.0.1", 0, 4.0, rules)
    output.open(FakeService())
    try:
        with ExitStack() as idle:
            for k in range(200):
                client = idle.enter_context(_connect(output.port))
                client.sendall(b"" if k % 2 else b"GET /api/map HTTP/1.1\r\nHost: ")
            for path in ("/", "/api/map"):
                connection = http.client.HTTPConnection("127.0.0.1", output.port, timeout=5)
                connection.request("GET", path, headers=BEARER)
                assert connection.getresponse().status == 200
                connection.close()
    finally:
        output.close()


def test_nobody_speaks_in_the_name_of_another_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    """Headers of proxies are a client's words: the connection decides whose attempts are counted."""
    seen, visit = list[object](), Door.visit
    monkeypatch.setattr(Door, "visit", lambda self, address: seen.append(tuple(address)) or visit(self, address))
    output = PageOutput("127.0.0.1", 0, 4.0, Access(TOKEN))
    output.open(FakeService())
    try:
        with _connect(output.port) as operator, _connect(output.port) as client:
            forged = ":".join(map(str, operator.getsockname()))
            client.sendall(f"GET /api/map HTTP/1.1\r\nHost: localhost\r\nX-Forwarded-For: {forged}\r\n\r\n".encode())
            assert client.recv(15).startswith(b"HTTP/1.1 401")
            assert set(seen) == {client.getsockname()}
    finally:
        output.close()


def test_silent_connections_do_not_close_the_pose_socket() -> None:
    output = PoseSocket(Place.read("tcp://127.0.0.1:0"), "json", Access(TOKEN))
    output.open(FakeService())
    output.put(started())
    try:
        with ExitStack() as silent:
            for _ in range(100):
                silent.enter_context(_connect(output.port))
            with _connect(output.port) as client:
                client.sendall(TOKEN.encode() + b"\n")
                _until(lambda: bool(output._clients))  # pyright: ignore[reportPrivateUsage]
                output.put(pose_update(7))
                assert json.loads(client.makefile().readline())["frame_id"] == 7
    finally:
        output.close()


def test_a_slow_handshake_on_the_pose_socket_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(door, "HANDSHAKE_S", 0.5)
    output = PoseSocket(Place.read("tcp://127.0.0.1:0"), "json", Access(TOKEN))
    output.open(FakeService())
    begin = time.monotonic()
    try:
        with _connect(output.port) as client:
            _drip(client, 90)
    finally:
        output.close()
    assert time.monotonic() - begin < 2.0


def test_a_client_that_reads_nothing_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    from stereo_sfm.service.outputs import pose_socket

    monkeypatch.setattr(pose_socket, "UNREAD_S", 0.3)
    output = PoseSocket(Place.read("tcp://127.0.0.1:0"), "json")
    output.open(FakeService())
    output.put(started())
    clients = output._clients  # pyright: ignore[reportPrivateUsage]
    try:
        with _connect(output.port), _connect(output.port) as reads:
            _until(lambda: len(clients) == 2)
            reads.settimeout(0.01)
            frame, end = 0, time.monotonic() + 10
            while len(clients) == 2 and time.monotonic() < end:
                output.put(pose_update(frame := frame + 1))
                try:
                    while reads.recv(1 << 20):
                        pass
                except TimeoutError:
                    pass
            assert len(clients) == 1
            output.put(pose_update(frame + 1))
            assert reads.recv(1 << 20)
    finally:
        output.close()


def test_guesses_at_a_port_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    output = PageOutput("127.0.0.1", 0, 4.0, Access(TOKEN))
    output.open(FakeService())
    web = output._web.door  # pyright: ignore[reportPrivateUsage]
    assert web is not None
    monkeypatch.setattr(web, "_peer_of", _by_source)
    try:

        def ask(token: str, source: str) -> int:
            connection = http.client.HTTPConnection("127.0.0.1", output.port, 5, source_address=(source, 0))
            connection.request("GET", "/api/map", headers={"Authorization": f"Bearer {token}"})
            status = connection.getresponse().status
            connection.close()
            return status

        answers = [ask(f"guess number {i}", "127.0.0.9") for i in range(100)]
        assert answers.count(401) <= 7 and answers.count(429) >= 93
        assert ask(TOKEN, "127.0.0.1") == 200  # somebody else
    finally:
        output.close()


def test_a_session_is_of_no_use_to_another_peer(monkeypatch: pytest.MonkeyPatch) -> None:
    """A browser sends a cookie of 127.0.0.1 to every port there: others of this computer can have it."""
    service = FakeService()
    output = PageOutput("127.0.0.1", 0, 4.0, Access(TOKEN))
    output.open(service)
    web = output._web.door  # pyright: ignore[reportPrivateUsage]
    assert web is not None
    monkeypatch.setattr(web, "_peer_of", _by_source)
    try:

        def ask(path: str, source: str, body: str | None = None, cookie: str = "") -> tuple[int, str]:
            connection = http.client.HTTPConnection("127.0.0.1", output.port, 5, source_address=(source, 0))
            more = {"Content-Type": "application/json", "X-Stereo-Sfm": "1", "Cookie": cookie}
            connection.request("GET" if body is None else "POST", path, body, more)
            answer = connection.getresponse()
            connection.close()
            return answer.status, answer.getheader("set-cookie", "").partition(";")[0]

        status, cookie = ask("/login", "127.0.0.1", json.dumps({"token": TOKEN}))
        assert status == 200
        for path, body in (("/api/map", None), ("/api/command/reset", "{}")):
            assert ask(path, "127.0.0.9", body, cookie)[0] == 401 and not service.calls
        for path, body in (("/api/map", None), ("/api/command/reset", "{}")):
            assert ask(path, "127.0.0.1", body, cookie)[0] == 200
    finally:
        output.close()
