"""Requests and messages that no client of ours would send, for tests and for `benchmarks attack`."""

from __future__ import annotations

import json
import random
import socket
import struct
from collections.abc import Iterator
from typing import Any

TOKEN = "a-token-of-thirty-two-characters"
PATHS = (
    "/", "/page.js", "/login", "/api/live", "/api/map", "/api/image.jpg", "/api/settings", "/api/recordings",
    "/api/recordings/r1", "/api/recordings/r1/0", "/api/recordings/r1/%s" % ("9" * 5000), "/api/recordings/r1/-1",
    "/api/recordings/r1/timeline", "/api/recordings/%00/timeline", "/api/recordings/r1/thumbnails/0",
    "/api/recordings/r1/thumbnails/%s" % ("9" * 5000), "/api/recordings/../../etc/thumbnails/-1",
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


def request(rng: random.Random, port: int, token: str = TOKEN) -> bytes:
    """A request to a port of this computer, half of them with the token."""
    body = rng.choice(BODIES)
    lines = [
        f"{rng.choice(METHODS[:2] if rng.random() < 0.7 else METHODS)} {rng.choice(PATHS)} HTTP/1.1",
        f"Host: 127.0.0.1:{port}",
        *rng.sample(HEADERS, rng.randrange(5)),
    ]
    if rng.random() < 0.8:
        lines += [f"Content-Length: {len(body)}", *HEADERS[:3:2]]
    if rng.random() < 0.5:
        lines.append(f"Authorization: Bearer {token}")
    data = "\r\n".join([*lines, "", ""]).encode("latin-1", "replace") + body
    if rng.random() < 0.2:  # any byte
        at = rng.randrange(len(data))
        data = data[:at] + rng.randbytes(rng.randrange(4)) + data[at + rng.randrange(3) :]
    return data


def status(port: int, data: bytes, half_close: bool = True) -> int:
    """The status of the answer, 0 where the connection is closed or stays silent."""
    with socket.create_connection(("127.0.0.1", port), 5) as client:
        client.settimeout(5)
        try:
            client.sendall(data)
            if half_close:
                client.shutdown(socket.SHUT_WR)
            words = client.recv(200).split(b" ", 2)
        except OSError:
            return 0
        return int(words[1]) if len(words) > 1 and words[0].startswith(b"HTTP/") else 0


def frames(rng: random.Random, count: int) -> Iterator[str | bytes]:
    """Messages to a WebSocket of Foxglove."""
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
    for _ in range(count):
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
