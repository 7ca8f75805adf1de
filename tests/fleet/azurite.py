"""Azurite, Microsoft's own server for tests, where `azurite-blob` is installed (npm install -g azurite)."""

from __future__ import annotations

import base64
import email.utils
import hashlib
import hmac
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Generator
from contextlib import contextmanager

BUCKET = "fleet"
ACCOUNT = "devstoreaccount1"  # account and key that Azurite documents for everybody
KEY = "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="


def make_container(url: str) -> None:
    """By a request that is signed with the key."""
    head = {"x-ms-date": email.utils.formatdate(usegmt=True), "x-ms-version": "2021-08-06"}
    lines = ["PUT", *[""] * 11, *(f"{name}:{value}" for name, value in sorted(head.items()))]
    text = "\n".join([*lines, f"/{ACCOUNT}/{ACCOUNT}/{BUCKET}", "restype:container"])
    mac = hmac.new(base64.b64decode(KEY), text.encode(), hashlib.sha256).digest()
    head["Authorization"] = f"SharedKey {ACCOUNT}:{base64.b64encode(mac).decode()}"
    request = urllib.request.Request(f"{url}/{ACCOUNT}/{BUCKET}?restype=container", b"", head, method="PUT")
    request.add_unredirected_header("Content-Type", "")
    urllib.request.urlopen(request, timeout=10).close()


@contextmanager
def server(program: str) -> Generator[str]:
    """A server with the container BUCKET; its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    options = ["--silent", "--skipApiVersionCheck", "--inMemoryPersistence", "--blobPort", str(port)]
    process = subprocess.Popen([program, *options])
    url, end = f"http://127.0.0.1:{port}", time.monotonic() + 60.0
    try:
        while True:
            try:
                make_container(url)
                break
            except urllib.error.HTTPError:
                raise
            except OSError:
                if time.monotonic() > end or process.poll() is not None:
                    raise
                time.sleep(0.2)
        yield url
    finally:
        process.kill()
        process.wait()
