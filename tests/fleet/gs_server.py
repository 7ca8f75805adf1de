"""A small server that answers as Google's storage does by XML, with objects in memory: for tests.

Generations rise with every put, and a put is carried out only if the generation is the one in its head.
"""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

BUCKET = "fleet"


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    objects: dict[str, tuple[bytes, int]]  # content and generation by name
    lock: threading.Lock

    def log_message(self, format: str, *args: Any) -> None:
        return

    def _answer(self, status: int, body: bytes = b"", **head: str) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **head}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _parsed(self) -> tuple[str, dict[str, str]] | None:
        """Name and query; None and an answer where the bucket does not exist."""
        parts = urlsplit(self.path)
        bucket, _, name = parts.path.lstrip("/").partition("/")
        if bucket == BUCKET:
            return unquote(name), {key: value[0] for key, value in parse_qs(parts.query).items()}
        self._answer(404, b"<Error><Code>NoSuchBucket</Code></Error>")
        return None

    def _content(self, name: str) -> None:
        found = self.objects.get(name)
        if found is None:
            self._answer(404, b"<Error><Code>NoSuchKey</Code></Error>")
            return
        body, generation = found
        head = {"ETag": f'"{generation}"', "x_goog_generation": str(generation),
                "Last_Modified": "Wed, 25 Nov 2026 22:00:00 GMT"}  # fmt: skip
        asked, size = self.headers.get("Range"), len(body)
        if asked:
            first, _, last = asked.removeprefix("bytes=").partition("-")
            begin, end = int(first), min(int(last or size), size - 1)
            body, head["Content_Range"] = body[begin : end + 1], f"bytes {begin}-{end}/{size}"
        self._answer(206 if asked else 200, body, **head)

    def do_HEAD(self) -> None:
        if (parsed := self._parsed()) is not None:
            self._content(parsed[0])

    def do_GET(self) -> None:
        parsed = self._parsed()
        if parsed is None or parsed[0]:
            if parsed:
                self._content(parsed[0])
            return
        prefix, delimiter = parsed[1].get("prefix", ""), parsed[1].get("delimiter", "")
        names = sorted(name for name in self.objects if name.startswith(prefix))
        cut = [prefix + n[len(prefix) :].partition("/")[0] + "/" if "/" in n[len(prefix) :] else "" for n in names]
        folders = sorted({c for c in cut if c}) if delimiter else []
        rows = "".join(f"<CommonPrefixes><Prefix>{escape(folder)}</Prefix></CommonPrefixes>" for folder in folders)
        for name, folder in zip(names, cut, strict=True):
            if not delimiter or not folder:
                body, generation = self.objects[name]
                rows += (
                    f"<Contents><Key>{escape(name)}</Key><Size>{len(body)}</Size><ETag>{generation}</ETag>"
                    "<LastModified>2026-11-25T22:00:00.000Z</LastModified></Contents>"
                )
        self._answer(200, f"<ListBucketResult>{rows}</ListBucketResult>".encode())

    def do_PUT(self) -> None:
        data = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        parsed = self._parsed()
        if parsed is None:
            return
        wanted = self.headers.get("x-goog-if-generation-match")
        with self.lock:
            before = self.objects.get(parsed[0], (b"", 0))[1]
            right = wanted is None or int(wanted) == before
            if right:
                self.objects[parsed[0]] = (data, before + 1)
        if not right:
            self._answer(412, b"<Error><Code>PreconditionFailed</Code></Error>")
            return
        self._answer(200, ETag=f'"{before + 1}"', x_goog_generation=str(before + 1))

    def do_DELETE(self) -> None:
        if (parsed := self._parsed()) is not None:
            gone = self.objects.pop(parsed[0], None)
            self._answer(404 if gone is None else 204)


@contextmanager
def server() -> Generator[str]:
    """A server with the bucket BUCKET; its address."""
    members = {"objects": dict[str, tuple[bytes, int]](), "lock": threading.Lock()}
    with ThreadingHTTPServer(("127.0.0.1", 0), type("OwnHandler", (Handler,), members)) as found:
        thread = threading.Thread(target=found.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{found.server_address[1]}"
        finally:
            found.shutdown()
            thread.join()
