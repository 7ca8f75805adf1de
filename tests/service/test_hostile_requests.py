"""Two thousand requests that no client of ours would send: each ends in an answer 4xx or a closed connection."""

from __future__ import annotations

import json
import random
import socket
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from stereo_sfm.service.outputs import guard
from stereo_sfm.service.outputs.access import Access
from stereo_sfm.service.outputs.foxglove_server import FoxgloveOutput
from stereo_sfm.service.outputs.settings import FoxgloveConfig
from stereo_sfm.service.page.server import PageOutput
from stereo_sfm.service.publisher import Reply
from tests.service.service_messages import FakeService

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

TOKEN = "a-token-of-thirty-two-characters"
COUNT = 2000
PATHS = (
    "/", "/page.js", "/login", "/api/live", "/api/map", "/api/image.jpg", "/api/settings", "/api/recordings",
    "/api/recordings/r1", "/api/recordings/r1/0", "/api/recordings/r1/%s" % ("9" * 5000), "/api/recordings/r1/-1",
    "/api/recordings/%00/1", "/api/recordings/%ff%fe/1", "/api/recordings/..%2f..%2fetc/0", "/api/command/mark",
    "/api/command/set_setting", "/api/command/delete_recording", "/api/command/%s" % ("x" * 3000), "/api/command/", "*",
    "//", "/../../etc/passwd", "/%", "/%zz", "/\u00e9", "http://evil.example/",
    "/api/floor_plan.png?version=" + "1" * 3000,
)  # fmt: skip
METHODS = ("GET", "POST", "PUT", "DELETE", "HEAD", "OPTIONS", "CONNECT", "PATCH", "get", "\x00", "X" * 300)
BODIES = (
    b"", b"{}", b'{"token": "\\ud800"}', b'{"token": 5}', b'{"text": "\\ud800\\u0000"}',
    b'{"name": "a", "value": "\\udfff"}',
    b"[" * 5000, b'{"a":' * 2000, b'{"token": ' + b"9" * 5000 + b"}", b"\xff\xfe", b"null", b"1e999", b'{"text": NaN}',
    b'{"id": "../../x"}', b'{"id": "\\u0000"}', b'{"name": "map.save_every_min", "value": "1e400"}',
    b" " * 20_000 + b"{}",
)  # fmt: skip
HEADERS = (
    "Content-Type: application/json", "Content-Type: \xff", "X-Stereo-Sfm: 1", "Cookie: stereo-sfm-session=\xff\xfe",
    "Cookie: " + "a=b;" * 500, "Authorization: Bearer \xe9", "Authorization: Bearer",
    "Authorization: Bearer " + "x" * 9000,
    "Origin: null", "Origin: \xff", "Transfer-Encoding: chunked", "Content-Length: -1", "Content-Length: 99999999999",
    "Range: bytes=5-1", "Range: bytes=" + "0-1," * 400, "Expect: 100-continue",
    "Upgrade: websocket", "Connection: Upgrade",
    "Sec-WebSocket-Key: x", "Sec-WebSocket-Version: 13", "If-Modified-Since: \xff", "Accept-Encoding: \x7f", "Host: b",
)  # fmt: skip


def _request(rng: random.Random, port: int) -> bytes:
    body = rng.choice(BODIES)
    lines = [
        f"{rng.choice(METHODS[:2] if rng.random() < 0.7 else METHODS)} {rng.choice(PATHS)} HTTP/1.1",
        f"Host: 127.0.0.1:{port}",
        *rng.sample(HEADERS, rng.randrange(5)),
    ]
    if rng.random() < 0.8:
        lines += [f"Content-Length: {len(body)}", *HEADERS[:3:2]]
    if rng.random() < 0.5:
        lines.append(f"Authorization: Bearer {TOKEN}")
    data = "\r\n".join([*lines, "", ""]).encode("latin-1", "replace") + body
    if rng.random() < 0.2:  # any byte
        at = rng.randrange(len(data))
        data = data[:at] + rng.randbytes(rng.randrange(4)) + data[at + rng.randrange(3) :]
    return data


def _status(port: int, data: bytes) -> int:
    """The status of the answer, 0 where the connection is closed or stays silent."""
    with socket.create_connection(("127.0.0.1", port), 5) as client:
        client.settimeout(5)
        try:
            client.sendall(data)
            client.shutdown(socket.SHUT_WR)
            words = client.recv(200).split(b" ", 2)
        except OSError:
            return 0
        return int(words[1]) if len(words) > 1 and words[0].startswith(b"HTTP/") else 0


@contextmanager
def _no_failure_of_ours(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Iterator[list[Any]]:
    """Nothing is printed, and the guard needs its last resort for nothing but bad numbers."""
    failures: list[Any] = []
    monkeypatch.setattr(guard.Guard, "_report", lambda self, scope, error: failures.append((scope["path"], error)))
    yield failures
    assert not capfd.readouterr().err
    assert all("digits" in str(error) for _, error in failures), failures


@pytest.mark.parametrize("rules", [Access(TOKEN), Access()])
def test_the_page_answers_anything(
    rules: Access, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    rng = random.Random(5)
    service = FakeService({"recording_files": Reply(True, "", {"files": []})})
    output = PageOutput("127.0.0.1", 0, 4.0, rules)
    output.open(service)
    try:
        with _no_failure_of_ours(monkeypatch, capfd):
            found = Counter(_status(output.port, _request(rng, output.port)) // 100 for _ in range(COUNT // 2))
        assert _status(output.port, f"GET / HTTP/1.1\r\nHost: localhost\r\nA: {TOKEN}\r\n\r\n".encode()) == 200
    finally:
        output.close()
    assert found[5] == 0 and found[4] > COUNT // 8 and found[2] > 10, found


def _frames(rng: random.Random) -> Iterator[str | bytes]:
    ops = ("subscribe", "unsubscribe", "getParameters", "setParameters", "advertise", "fetchAsset", "", 5)
    values: tuple[Any, ...] = (
        1,
        -1,
        2**40,
        1.5,
        "x",
        "\ud800",
        None,
        [],
        {},
        [[]],
        [{}],
        ["a"],
        [{"id": 1, "channelId": 1}],
    )
    names = ("op", "subscriptions", "subscriptionIds", "parameterNames", "parameters", "id", "channels")
    for _ in range(COUNT // 4):
        kind = rng.randrange(4)
        if kind == 0:
            yield json.dumps({"op": rng.choice(ops), **{rng.choice(names[1:]): rng.choice(values) for _ in range(3)}})
        elif kind == 1:
            yield struct.pack(
                "<BIII", rng.choice((1, 2, 2, 2)), rng.randrange(12), 7, rng.randrange(9)
            ) + rng.randbytes(9)
        elif kind == 2:
            yield rng.randbytes(rng.randrange(40))
        else:
            yield rng.choice(("[" * 5000, "{", "null", "1" * 6000, '"', "{}" * 9))


def test_foxglove_answers_anything(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    connect: Callable[..., Any] = pytest.importorskip("websockets.sync.client").connect
    output = FoxgloveOutput(FoxgloveConfig(port=0), Access(TOKEN))
    output.open(FakeService())
    address, rng = f"ws://127.0.0.1:{output.port}/?token={TOKEN}", random.Random(6)
    try:
        with _no_failure_of_ours(monkeypatch, capfd) as failures:
            assert Counter(_status(output.port, _request(rng, output.port)) // 100 for _ in range(COUNT // 4))[5] == 0
            with connect(address, subprotocols=["foxglove.sdk.v1"], max_queue=None) as client:
                for frame in _frames(rng):
                    client.send(frame)
                client.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "the last one"}))
                while "the last one" not in str(client.recv(timeout=10)):
                    pass
        assert not failures
    finally:
        output.close()
