"""An S3 server, a plan and small maps."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import pytest

from stereo_sfm.fleet.plan import Plan, load_plan
from stereo_sfm.maps.saved_map import save_map
from tests.fleet.s3_server import BUCKET, KEY, Server, server
from tests.maps.maps import small_map


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


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot's own map of a walk."""
    folder = tmp_path_factory.mktemp("session") / "map"
    save_map(small_map()[1], folder)
    return folder


@pytest.fixture
def plan(place: str, tmp_path: Path) -> Plan:
    file = tmp_path / "plan.toml"
    file.write_text(f'[fleet]\nroot = "{place}"\nkeep_images_days = 30\n')
    return load_plan(file)
