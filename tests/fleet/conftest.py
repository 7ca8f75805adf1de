"""An S3 server and small maps."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fleet.s3_server import BUCKET, KEY, Server, server


@pytest.fixture(scope="session")
def s3_process() -> Iterator[Server]:
    """Started once: importing moto takes a second."""
    for module in ("obstore", "moto", "flask"):
        pytest.importorskip(module)
    with server() as found:
        yield found


_numbers = itertools.count()


@pytest.fixture
def s3(s3_process: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Server]:
    """The server without faults, its clients' environment, and a cache of this test."""
    from stereo_sfm.storage import objects

    for name, value in s3_process.environment(KEY).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("STEREO_SFM_CACHE", str(tmp_path / "cache"))
    objects._store.cache_clear()  # pyright: ignore[reportPrivateUsage]
    yield s3_process
    s3_process.faults(0.0)
    objects._store.cache_clear()  # pyright: ignore[reportPrivateUsage]


@pytest.fixture
def place(s3: Server) -> str:
    """An address that no other test uses."""
    return f"s3://{BUCKET}/{next(_numbers)}"
