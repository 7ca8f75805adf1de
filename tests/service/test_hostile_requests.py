"""Two thousand requests that no client of ours would send: each ends in an answer 4xx or a closed connection."""

from __future__ import annotations

import json
import logging
import random
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any

import pytest

from stereo_sfm.service.outputs import guard
from stereo_sfm.service.outputs.access import Access
from stereo_sfm.service.outputs.foxglove_server import FoxgloveOutput
from stereo_sfm.service.outputs.settings import FoxgloveConfig
from stereo_sfm.service.page.server import PageOutput
from stereo_sfm.service.publisher import Reply
from tests.service.hostile import TOKEN, frames, request, status
from tests.service.service_messages import FakeService

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

COUNT = 2000


@contextmanager
def _no_failure_of_ours(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> Generator[list[Any]]:
    """Nothing is printed or logged as an error, and the guard needs its last resort for nothing but bad numbers."""
    failures: list[Any] = []
    monkeypatch.setattr(guard.Guard, "_report", lambda self, scope, error: failures.append((scope["path"], error)))
    yield failures
    assert not capfd.readouterr().err
    assert not [record.exc_info for record in caplog.records if record.levelno >= logging.ERROR]
    assert all("digits" in str(error) for _, error in failures), failures


@pytest.mark.parametrize("rules", [Access(TOKEN), Access()])
def test_the_page_answers_anything(
    rules: Access, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    rng = random.Random(5)
    service = FakeService({"recording_files": Reply(True, "", {"files": []})})
    output = PageOutput("127.0.0.1", 0, 4.0, rules)
    output.open(service)
    try:
        with _no_failure_of_ours(monkeypatch, capfd, caplog):
            found = Counter(status(output.port, request(rng, output.port)) // 100 for _ in range(COUNT // 2))
        assert status(output.port, f"GET / HTTP/1.1\r\nHost: localhost\r\nA: {TOKEN}\r\n\r\n".encode()) == 200
    finally:
        output.close()
    assert found[5] == 0 and found[4] > COUNT // 8 and found[2] > 10, found


def test_a_bad_body_of_a_head_request_is_refused_quietly(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    with _no_failure_of_ours(monkeypatch, capfd, caplog):
        output = PageOutput("127.0.0.1", 0, 4.0, Access(TOKEN))
        output.open(FakeService())
        head = f"HEAD / HTTP/1.1\r\nHost: 127.0.0.1:{output.port}\r\nTransfer-Encoding: chunked\r\n\r\n"
        try:
            assert status(output.port, head.encode() + b" " * 20_000) in (0, 400)
        finally:
            output.close()


def test_foxglove_answers_anything(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    connect: Callable[..., Any] = pytest.importorskip("websockets.sync.client").connect
    output = FoxgloveOutput(FoxgloveConfig(port=0), Access(TOKEN))
    output.open(FakeService())
    address, rng = f"ws://127.0.0.1:{output.port}/?token={TOKEN}", random.Random(6)
    try:
        with _no_failure_of_ours(monkeypatch, capfd, caplog) as failures:
            assert Counter(status(output.port, request(rng, output.port)) // 100 for _ in range(COUNT // 4))[5] == 0
            with connect(address, subprotocols=["foxglove.sdk.v1"], max_queue=None) as client:
                for frame in frames(rng, COUNT // 4):
                    client.send(frame)
                client.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "the last one"}))
                while "the last one" not in str(client.recv(timeout=10)):
                    pass
        assert not failures
    finally:
        output.close()
