"""An S3 server for tests: moto's, which keeps objects in memory, in a process of its own.

    python -m tests.fleet.s3_server [--seed 1]

prints its port. It adds what moto lacks: conditional puts are atomic (a lock), a part of the answers is 503 (before the
request is carried out, or after it, so that the answer alone is lost), buckets are full, keys are checked, and may be
limited to a prefix.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode

ROOT = Path(__file__).parents[2]
KEY, READER = "the-key", "reads-only"  # the second one may not write
LIMITED = "only-in-"  # a key that begins so, with a prefix whose slashes are dots, has the rights of this prefix
BUCKET = "fleet"
FULL = {  # what servers answer where a limit is reached
    "ceph": ("403 Forbidden", "QuotaExceeded"),
    "minio": ("507 Insufficient Storage", "XMinioStorageFull"),
    "minio bucket": ("400 Bad Request", "XMinioAdminBucketQuotaExceeded"),
}


class Faulty:
    """A WSGI application around moto's."""

    def __init__(self, app: Any, seed: int) -> None:
        self._app, self._fail, self._full = app, 0.0, ""
        self._random, self._lock = random.Random(seed), threading.RLock()
        self._sent, self._written = 0, 0

    def __call__(self, environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        if path == "/-/faults":  # of the test: "?fail=0.1&full=ceph"
            asked = dict(parse_qsl(environ["QUERY_STRING"]))
            self._fail, self._full = float(asked["fail"]), asked.get("full", "")
            return _answer(start, "200 OK", f"{self._sent} {self._written}")
        who = environ.get("HTTP_AUTHORIZATION", "")
        if not _may(environ, who.partition("Credential=")[2].partition("/")[0]):
            return _answer(start, *DENIED)
        if self._full and (method == "PUT" or (method == "POST" and "uploads" in environ["QUERY_STRING"])):
            status, code = FULL[self._full]
            return _answer(start, status, f"<Error><Code>{code}</Code></Error>")
        with self._lock:
            fails, late = self._random.random() < self._fail, self._random.random() < 0.5
        if fails and not late:
            return _answer(start, "503 Slow Down", "<Error><Code>SlowDown</Code></Error>")
        conditional = "HTTP_IF_MATCH" in environ or "HTTP_IF_NONE_MATCH" in environ
        answers: list[tuple[str, Any]] = []
        with self._lock if conditional and method == "PUT" else threading.Lock():
            body = b"".join(self._app(environ, lambda status, headers, *_: answers.append((status, headers))))
        self._sent += len(body)
        self._written += int(environ.get("CONTENT_LENGTH") or 0) if method == "PUT" else 0
        if fails:
            return _answer(start, "503 Slow Down", "<Error><Code>SlowDown</Code></Error>")
        if f"Credential={LIMITED}" in who and answers[0][0].startswith("404"):
            return _answer(start, *DENIED)  # as S3 does, where not all of the bucket may be listed
        start(*answers[0])
        return [body]


DENIED = ("403 Forbidden", "<Error><Code>AccessDenied</Code></Error>")


def _may(environ: dict[str, Any], key: str) -> bool:
    """Whether a key has the right to a request."""
    if key.startswith(LIMITED):
        asked = dict(parse_qsl(environ["QUERY_STRING"])).get("prefix", "")
        _, _, name = environ["PATH_INFO"].removeprefix("/").partition("/")
        return (name or asked).startswith(f"{key.removeprefix(LIMITED).replace('.', '/')}/")
    return key == KEY or (key == READER and environ["REQUEST_METHOD"] in ("GET", "HEAD"))


def _answer(start: Callable[..., Any], status: str, text: str) -> list[bytes]:
    start(status, [("Content-Type", "application/xml"), ("Content-Length", str(len(text)))])
    return [text.encode()]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--port", type=int, default=0)
    options = parser.parse_args()
    from moto.server import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        protocol_version = "HTTP/1.1"

        def log(self, type: str, message: str, *args: Any) -> None:
            return

    app = Faulty(DomainDispatcherApplication(create_backend_app), options.seed)
    server = make_server("127.0.0.1", options.port, app, threaded=True, request_handler=Quiet)
    print(server.server_port, flush=True)
    server.serve_forever()


class Server:
    """The process, and the environment of its clients."""

    def __init__(self, *arguments: str) -> None:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.fleet.s3_server", *arguments], stdout=subprocess.PIPE, text=True, cwd=ROOT,
            env=environment,
        )  # fmt: skip
        assert self.process.stdout is not None
        self.url = f"http://127.0.0.1:{int(self.process.stdout.readline())}"

    def environment(self, key: str = KEY) -> dict[str, str]:
        return {
            "AWS_ENDPOINT_URL": self.url, "AWS_ACCESS_KEY_ID": key, "AWS_SECRET_ACCESS_KEY": "the-secret",
            "AWS_REGION": "us-east-1",
        }  # fmt: skip

    def request(self, method: str, path: str) -> str:
        import urllib.request

        head = {"Authorization": f"AWS4-HMAC-SHA256 Credential={KEY}/20260101/us-east-1/s3/aws4_request"}
        with urllib.request.urlopen(urllib.request.Request(self.url + path, method=method, headers=head)) as answer:
            return answer.read().decode()

    def make_bucket(self, name: str = BUCKET) -> None:
        self.request("PUT", f"/{name}")

    def faults(self, share: float, full: str = "") -> tuple[int, int]:
        """Let this share of the answers fail, and every write if it is full in the manner of a server of `FULL`;
        returns the bytes sent and received until now."""
        sent, received = self.request("GET", f"/-/faults?{urlencode({'fail': share, 'full': full})}").split()
        return int(sent), int(received)

    def hold(self) -> None:
        self.process.send_signal(signal.SIGSTOP)

    def go_on(self) -> None:
        self.process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        self.go_on()
        self.process.kill()
        self.process.wait()


@contextmanager
def server(*arguments: str) -> Iterator[Server]:
    """A server with the bucket BUCKET."""
    found = Server(*arguments)
    try:
        found.make_bucket()
        yield found
    finally:
        found.close()


if __name__ == "__main__":
    main()
