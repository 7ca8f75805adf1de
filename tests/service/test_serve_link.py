"""The link of the page is printed once the page is there; who asks for one is told when nobody answers."""

from __future__ import annotations

import signal
import socket
from pathlib import Path
from typing import Self

import pytest

from stereo_sfm.cli import main
from stereo_sfm.pipeline import fork_server
from stereo_sfm.service import service as service_module
from stereo_sfm.service.config import RobotConfig


class Waits:
    """Stands in for the service: its page opens after some waits, if at all."""

    error = None
    opens_after = 2

    def __init__(self, config: RobotConfig) -> None:
        self.waits = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        return

    def wait(self, timeout_s: float) -> bool:
        self.waits += 1
        return self.waits > 5

    @property
    def open_outputs(self) -> frozenset[str]:
        return frozenset({"page", "foxglove"} if self.waits > self.opens_after else {"foxglove"})


@pytest.fixture
def token(tmp_path: Path) -> str:
    (tmp_path / "token").write_text("t" * 40)
    (tmp_path / "token").chmod(0o600)
    return f"security.token_file={tmp_path / 'token'}"


@pytest.fixture
def options(monkeypatch: pytest.MonkeyPatch, token: str) -> list[str]:
    monkeypatch.setattr(service_module, "Service", Waits)
    monkeypatch.setattr(signal, "signal", lambda number, action: None)
    monkeypatch.setattr(fork_server, "kill_fork_server", lambda: None)
    return ["--set", "page.enabled=true", "--set", token]


def test_the_link_comes_with_the_page(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "sim:loop", *options]) == 0
    assert capsys.readouterr().out.count("the page: http://127.0.0.1:8080/#") == 1
    assert main(["serve", "sim:loop", "-q", *options]) == 0
    assert not capsys.readouterr().out


def test_a_page_that_does_not_open_has_no_link(
    options: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Waits, "opens_after", 100)
    assert main(["serve", "sim:loop", *options]) == 0
    assert "the page" not in capsys.readouterr().out


@pytest.mark.parametrize("enabled", ["true", "false"])
def test_a_link_to_nothing_is_called_so(enabled: str, token: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["serve", "--print-link", "--set", token]
    with socket.socket() as place:
        place.bind(("127.0.0.1", 0))
        port = place.getsockname()[1]
        words += ["--set", f"page.port={port}", "--set", f"page.enabled={enabled}"]
        assert main(words) == 0
        out, err = capsys.readouterr()
        assert f"http://127.0.0.1:{port}/#" in out and f"no service answers at 127.0.0.1, port {port}" in err
        assert ("page.enabled is false" in err) == (enabled == "false")
        place.listen()
        assert main(words) == 0
        out, err = capsys.readouterr()
        assert f"http://127.0.0.1:{port}/#" in out and not err
