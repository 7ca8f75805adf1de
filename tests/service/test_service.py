"""The whole service on a small source: poses, the map, commands, and stages that die or hang."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from stereo_sfm.cli import main
from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps.saved_map import load_map
from stereo_sfm.service import service as service_module
from stereo_sfm.service.config import MapConfig, RecordingConfig, RobotConfig, SourceConfig
from stereo_sfm.service.messages import PoseUpdate, ServiceState, Started, Status
from stereo_sfm.service.service import Service
from tests.service.endless import endless_wall

PATIENCE_S = 60.0
STOP_S = 5.0


def wait_for(what: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < end
        time.sleep(0.02)


def config(tmp_path: Path, mode: str = "extend", every_min: float = 5.0) -> RobotConfig:
    return RobotConfig(
        map=MapConfig(str(tmp_path / "store"), mode, save_every_min=every_min),
        recording=RecordingConfig(folder=str(tmp_path / "recordings")),
    )


def test_pipelines_go_first_and_outputs_do_not(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Clients keep outputs busy; the process from which stages are forked is started by the thread of the pipelines."""
    raised: list[str] = []
    monkeypatch.setattr(service_module, "raise_priority", lambda: raised.append(threading.current_thread().name))
    with Service(config(tmp_path), MadeSource.of(endless_wall), outputs={}):
        wait_for(lambda: raised)
    assert raised == ["pipelines"]


def test_nobody_else_reads_what_serve_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    masks = list[int]()

    def service(_: RobotConfig) -> Service:
        masks.append(os.umask(0))
        raise StereoSfmError("enough")

    monkeypatch.setattr(service_module, "Service", service)
    before = os.umask(0o022)
    try:
        assert main(["serve", "sim:loop"]) == StereoSfmError.exit_code
    finally:
        os.umask(before)
    assert masks == [0o027]


@pytest.mark.slow
@pytest.mark.usefixtures("beside")
def test_a_session_its_map_and_the_next_one(tmp_path: Path) -> None:
    poses, states = list[PoseUpdate](), list[Status]()
    with Service(config(tmp_path), MadeSource.of(endless_wall)) as service:
        service.on(PoseUpdate, poses.append)
        service.on(Status, states.append)
        wait_for(lambda: len(poses) > 200)
        assert service.call("save_map", {"name": "copy"}).ok
        assert service.call("save_map", {"name": "../copy"}).text.startswith("'../copy' is not a plain name: ")
        reply = service.status()
        assert reply.data["status"]["state"] == "running" and reply.data["health"]["rss"]["tracker"] > 1e7
        children = [psutil.Process(pid) for pid in service.pids.values()]
        began = time.monotonic()
    assert time.monotonic() - began < STOP_S
    assert len(children) == 5 and not any(child.is_running() for child in children)
    assert [p.frame_id for p in poses] == list(range(len(poses))) and not any(p.localized for p in poses)
    assert states[-1].state == ServiceState.STOPPING and service.error is None
    first, copy = load_map(tmp_path / "store"), load_map(tmp_path / "copy")
    assert len(first) >= len(copy) > 0 and {p.name for p in tmp_path.iterdir()} == {"store", "store.versions", "copy"}

    poses.clear()
    with Service(config(tmp_path), MadeSource.of(endless_wall)) as service:
        service.on(PoseUpdate, poses.append)
        wait_for(lambda: poses and poses[-1].localized and len(poses) > 60)
        assert service.save_map().ok
    assert load_map(tmp_path / "store").session_ids == [0, 1]


@pytest.mark.slow
@pytest.mark.usefixtures("beside")
@pytest.mark.parametrize(
    ("what", "stage"), [(signal.SIGKILL, "tracker"), (signal.SIGKILL, "capture"), (signal.SIGSTOP, "mapper")]
)
def test_a_dead_or_hung_stage_costs_seconds(what: signal.Signals, stage: str, tmp_path: Path) -> None:
    poses, sessions = list[PoseUpdate](), list[Started]()
    settings = replace(config(tmp_path), recording=RecordingConfig(str(tmp_path / "recordings"), "full", "raw"))
    with Service(settings, MadeSource.of(endless_wall)) as service:
        service.on(PoseUpdate, poses.append)
        service.on(Started, sessions.append)
        wait_for(lambda: len(poses) > 60 and "recorder" in service.pids)
        assert service.save_map().ok
        recorder = service.pids["recorder"]
        os.kill(service.pids[stage], what)
        wait_for(lambda: len(sessions) == 2)
        wait_for(lambda: poses[-1].session == 2 and poses[-1].localized)
        assert service.status().data["health"]["restarts"] == 1
        assert service.pids["recorder"] == recorder  # it goes on


@pytest.mark.slow
@pytest.mark.usefixtures("beside")
def test_the_end_of_a_recording_ends_the_service_with_its_map_saved(tmp_path: Path) -> None:
    from tests.pipeline.test_pipeline import SlidingWall

    with Service(config(tmp_path), MadeSource.of(SlidingWall, 60)) as service:
        assert service.wait(PATIENCE_S)
    assert service.error is None and len(load_map(tmp_path / "store")) > 0


def test_a_source_that_cannot_be_opened_ends_it_with_one_line(tmp_path: Path) -> None:
    settings = RobotConfig(source=SourceConfig(spec="/nowhere.mcap"), map=MapConfig(str(tmp_path / "store")))
    with pytest.raises(StereoSfmError, match="nowhere"):
        Service(settings)
    nothing = config(tmp_path, "localize")
    states = list[Status]()
    service = Service(nothing, MadeSource.of(endless_wall))
    service.on(Status, states.append)
    with service:
        assert service.wait(PATIENCE_S)
    assert "no map at" in str(service.error)
    assert states[-1].state == ServiceState.STOPPING and "no map at" in states[-1].reason
