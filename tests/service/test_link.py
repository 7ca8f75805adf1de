"""The process of an output: what it gets, what it asks, and what its death does."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service import link
from stereo_sfm.service.config import RobotConfig, SecurityConfig
from stereo_sfm.service.link import OutputProcess
from stereo_sfm.service.messages import ServiceState, Status
from stereo_sfm.service.publisher import Reply, checked

PATIENCE_S = 30.0


def wait_for(what: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < end
        time.sleep(0.02)


def answer(name: str, arguments: dict[str, Any]) -> Reply:
    return Reply(True, f"{name} {arguments['text']}")


def output(path: Path, make: str = "make") -> OutputProcess:
    config = RobotConfig(security=SecurityConfig(token_file=str(path)))
    made = OutputProcess("test", config, answer, f"tests.service.fake_output:{make}")
    made.start()
    return made


def send(to: OutputProcess, reason: str) -> None:
    to.offer(Status, pickle.dumps(Status(ServiceState.RUNNING, reason)))


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []


@pytest.mark.usefixtures("beside")
def test_an_output_calls_dies_and_is_started_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link, "FIRST_PAUSE_S", 0.1)
    path = tmp_path / "lines"
    made = output(path)
    wait_for(lambda: bool(made.wants))
    send(made, "ask")
    wait_for(lambda: any("mark bump" in line for line in lines(path)))
    send(made, "die")
    wait_for(lambda: made.starts == 2 and bool(made.wants))
    send(made, "again")
    wait_for(lambda: "Status again" in lines(path))
    made.close()
    assert lines(path)[-1] == "closed"


def test_a_slow_output_loses_the_oldest_and_never_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link, "LIMIT", 2)
    path = tmp_path / "lines"
    made = output(path, "make_slow")
    wait_for(lambda: bool(made.wants))
    padding = "x" * 100_000  # more than fits into the pipe
    began = time.monotonic()
    for k in range(100):
        send(made, f"{k} {padding}")
    assert time.monotonic() - began < 5.0
    wait_for(lambda: any(line.startswith("Status 99 ") for line in lines(path)))
    made.close()
    assert len(lines(path)) < 20


def test_a_taken_port_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any) -> None:
    path = tmp_path / "lines"
    path.with_suffix(".taken").touch()
    made = output(path)
    wait_for(lambda: any("port 1 is taken" in record.getMessage() for record in caplog.records))
    assert not made.wants
    made.close()
    assert made.pid is not None and not lines(path)


def test_arguments_of_commands_are_checked() -> None:
    assert checked("mark", {}) == {"text": ""} and checked("start_recording", {"mode": "lean"}) == {"mode": "lean"}
    for name, arguments, why in (
        ("marks", {}, "did you mean mark"),
        ("reset", {"now": True}, "takes no arguments"),
        ("mark", {"txt": ""}, "did you mean text"),
        ("mark", {"text": 3}, "must be str"),
        ("mark", {"text": "a\nb"}, "one line"),
        ("mark", {"text": "a" * 2000}, "1000"),
    ):
        with pytest.raises(StereoSfmError, match=why):
            checked(name, arguments)
