"""What a stop waits for: on a busy computer it must not be one thing after the other."""

from __future__ import annotations

import fcntl
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.messages import MapSaved
from stereo_sfm.pipeline.processes import END_S, IN_FLIGHT_S, SAVE_END_S, ProcessRun
from stereo_sfm.service import link, service
from stereo_sfm.service.config import MapConfig, RobotConfig
from stereo_sfm.service.link import OutputProcess
from stereo_sfm.service.outputs import dds_memory
from stereo_sfm.service.publisher import Reply
from stereo_sfm.service.service import Service
from tests.service.endless import endless_wall

PATIENCE_S = 60.0


@pytest.mark.parametrize(("ready", "saved"), [(True, False), (True, True), (False, False)])
def test_stages_with_a_backlog_are_waited_for_only_until_the_map_is_written(
    ready: bool, saved: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Nor is a mapper that still loads its code: it has no map."""
    run, ended = ProcessRun(MadeSource.of(endless_wall), Config()), list[float]()
    monkeypatch.setattr(run, "_end_now", lambda: ended.append(waited_s))
    run._not_ready = set() if ready else {"mapper"}  # pyright: ignore[reportPrivateUsage]
    run._capturing = True  # pyright: ignore[reportPrivateUsage]
    run.save_map(tmp_path, urgent=True)
    if saved:
        run._dispatch(MapSaved(str(tmp_path), 1))  # pyright: ignore[reportPrivateUsage]
    for tenth in range(60):
        waited_s = tenth / 10
        run._progress_s = time.monotonic() - END_S - 1  # pyright: ignore[reportPrivateUsage]
        run._enforce_end(waited_s, time.monotonic(), [])  # pyright: ignore[reportPrivateUsage]
    assert ended and min(ended) == pytest.approx(0.1 + (SAVE_END_S if ready and not saved else IN_FLIGHT_S), abs=0.11)


def test_before_the_first_image_only_the_camera_is_waited_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    run, ended = ProcessRun(MadeSource.of(endless_wall), Config()), list[bool]()
    monkeypatch.setattr(run, "_end_now", lambda: ended.append(True))
    for waiting, ends in (({"capture", "tracker"}, False), ({"tracker", "mapper"}, True)):
        monkeypatch.setattr(type(run._stages), "waiting", waiting)  # pyright: ignore[reportPrivateUsage]
        ended.clear()
        run._enforce_end(0.1, time.monotonic(), [])  # pyright: ignore[reportPrivateUsage]
        assert bool(ended) == ends


def test_an_output_that_is_not_open_yet_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy computer it loads its code for longer than a stop may take."""

    class Loading:
        def __init__(self) -> None:
            self.joined, self.killed = list[float](), False

        def join(self, timeout_s: float) -> None:
            self.joined.append(timeout_s)

        def is_alive(self) -> bool:
            return not self.killed

        def kill(self) -> None:
            self.killed = True

    process = Loading()
    output = OutputProcess("pose_socket", RobotConfig(), lambda *_: Reply(True, ""))
    monkeypatch.setattr(output, "_thread", process)
    monkeypatch.setattr(output, "_process", process)
    output.close()
    assert process.killed and len(process.joined) == 1  # the thread that has started it


@pytest.mark.usefixtures("beside")
def test_an_output_that_is_started_during_a_stop_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else it would wait for messages, and the service for its end."""
    output = OutputProcess("pose_socket", RobotConfig(), lambda *_: Reply(True, ""))
    start = link.start_child

    def started(*arguments: Any) -> Any:
        output._closing.set()  # pyright: ignore[reportPrivateUsage]
        return start(*arguments)

    monkeypatch.setattr(link, "start_child", started)
    thread = threading.Thread(target=output._run_once, daemon=True)  # pyright: ignore[reportPrivateUsage]
    thread.start()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()


def test_recorder_and_outputs_end_while_the_map_is_still_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(service, "OTHERS_S", 0.2)
    recorder, outputs, waited = threading.Event(), threading.Event(), list[bool]()
    config = RobotConfig(map=MapConfig(str(tmp_path / "store")))
    with Service(config, MadeSource.of(endless_wall), outputs={}) as running:
        monkeypatch.setattr(running._recorder, "close", recorder.set)  # pyright: ignore[reportPrivateUsage]
        monkeypatch.setattr(running._hub, "close", outputs.set)  # pyright: ignore[reportPrivateUsage]

        def finish(*_: object) -> None:
            waited.append(recorder.wait(PATIENCE_S) and outputs.wait(PATIENCE_S))

        monkeypatch.setattr(running._maps, "finish", finish)  # pyright: ignore[reportPrivateUsage]
    assert waited == [True]


def test_shared_memory_of_dds_that_nobody_uses_is_removed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(dds_memory, "SHARED", tmp_path)
    used = ["fastrtps_port7000", "fastrtps_port7000_el", "sem.fastrtps_port7000_mutex"]
    left = ["fastrtps_0a1b", "fastrtps_0a1b_el", "fastrtps_port7411", "fastrtps_port7411_el"]
    others = ["stereo_sfm_ring_1", "fast_el", "sem.another"]
    for name in (*used, *left, "sem.fastrtps_port7411_mutex", *others):
        (tmp_path / name).touch()
    with (tmp_path / "fastrtps_port7000_el").open("r+b") as held:
        fcntl.flock(held, fcntl.LOCK_SH)  # a port that several processes read
        dds_memory.sweep()
        assert {path.name for path in tmp_path.iterdir()} == {*used, *others}
    dds_memory.sweep()
    assert {path.name for path in tmp_path.iterdir()} == set(others)
