"""The table of faults in docs/tasks/service.md, each caused for real on a running service."""

from __future__ import annotations

import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Generator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.log import topics
from stereo_sfm.log.reader import LogReader
from stereo_sfm.maps.saved_map import load_map
from stereo_sfm.recording.segments import recordings, segments
from stereo_sfm.service.config import MapConfig, RecordingConfig, RobotConfig
from stereo_sfm.service.messages import PoseUpdate, ServiceState, Started, Status
from stereo_sfm.service.outputs.settings import OutputsConfig, PageConfig, PoseSocketConfig, SecurityConfig
from stereo_sfm.service.service import Service
from tests.service.endless import endless_wall
from tests.service.test_service import PATIENCE_S, STOP_S, wait_for

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("beside")]
DEMO = Path(__file__).parents[2] / "recordings" / "demo.mcap"


def config(tmp_path: Path, root: Path | None = None) -> RobotConfig:
    recording = RecordingConfig(
        str(root or tmp_path / "recordings"), "full", "raw", segment_min=0.05, quota_gb=1.0, min_free_gb=0.0
    )
    return RobotConfig(map=MapConfig(str(tmp_path / "store")), recording=recording)


class Running:
    """A service with what it said."""

    def __init__(self, service: Service) -> None:
        self.service, self.poses, self.states = service, list[PoseUpdate](), list[Status]()
        service.on(PoseUpdate, self.poses.append)
        service.on(Status, self.states.append)

    def more_poses(self, count: int = 30) -> None:
        before = len(self.poses)
        wait_for(lambda: len(self.poses) >= before + count)

    def no_pose_is_missing(self) -> bool:
        return [p.frame_id for p in self.poses] == list(range(len(self.poses)))


@contextmanager
def running(settings: RobotConfig) -> Generator[Running]:
    with Service(settings, MadeSource.of(endless_wall)) as service:
        watched = Running(service)
        watched.more_poses()
        yield watched


@pytest.mark.parametrize("fault", [signal.SIGKILL, signal.SIGSTOP])
def test_a_dead_or_hung_recorder_costs_no_pose(fault: signal.Signals, tmp_path: Path) -> None:
    with running(config(tmp_path)) as watched:
        wait_for(lambda: any(file.stat().st_size > 1e5 for file in tmp_path.rglob("*.images.mcap")))  # it starts last
        pid = watched.service.pids["recorder"]
        os.kill(pid, fault)
        wait_for(lambda: watched.service.pids.get("recorder") not in (None, pid))
        wait_for(lambda: len(recordings(tmp_path / "recordings")) == 2)
        watched.more_poses(90)
        assert watched.no_pose_is_missing() and watched.service.status().data["health"]["restarts"] == 0
    first, second = recordings(tmp_path / "recordings")
    for folder in (first, second):
        with open_source(folder) as source:
            assert sum(1 for _ in source) > 5


def test_sessions_that_died_leave_no_file_open(tmp_path: Path) -> None:
    with running(config(tmp_path)) as watched:
        sessions, opened = list[Started](), list[int]()
        watched.service.on(Started, sessions.append)
        for count in range(1, 5):
            wait_for(lambda: len(sessions) >= count)  # noqa: B023
            watched.more_poses(250)  # a standby is started, after the session before is forgotten
            opened.append(len(os.listdir("/proc/self/fd")))
            os.kill(watched.service.pids["tracker"], signal.SIGKILL)
    assert opened[3] <= opened[1] + 2, opened


def test_a_killed_loop_closer_costs_no_session(tmp_path: Path) -> None:
    with running(config(tmp_path)) as watched:
        pid = watched.service.pids["loop"]
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda: watched.service.pids.get("loop") not in (None, pid))
        watched.more_poses(60)
        assert watched.no_pose_is_missing()
        assert watched.service.status().data["health"]["restarts"] == 0


@pytest.mark.parametrize("fault", [signal.SIGKILL, signal.SIGSTOP])
def test_a_dead_or_stopped_map_saver_is_replaced(fault: signal.Signals, tmp_path: Path) -> None:
    with running(config(tmp_path)):
        pass
    with running(config(tmp_path)) as watched:
        wait_for(lambda: "map saver" in watched.service.pids)
        os.kill(watched.service.pids["map saver"], fault)
        wait_for(lambda: watched.service.save_map().ok)
        watched.more_poses()
        assert watched.no_pose_is_missing()
    assert load_map(tmp_path / "store").session_ids == [0, 1]


def test_a_stage_that_gets_no_memory_is_started_again(tmp_path: Path) -> None:
    with running(config(tmp_path)) as watched:
        sessions = list[Started]()
        watched.service.on(Started, sessions.append)
        wait_for(lambda: sessions)
        resource.prlimit(watched.service.pids["mapper"], resource.RLIMIT_AS, (1 << 20, 1 << 20))  # less than it has
        wait_for(lambda: len(sessions) == 2 and watched.poses[-1].session == 2)
        assert watched.service.status().data["health"]["restarts"] == 1


@contextmanager
def small_disk(tmp_path: Path) -> Generator[Path]:
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=200m", "none", str(disk)], check=False)
    if mounted.returncode:
        pytest.skip("cannot mount here")
    try:
        yield disk
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=False)


@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a small disk")
def test_a_disk_that_is_read_only_at_first(tmp_path: Path) -> None:
    with small_disk(tmp_path) as disk:
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        with running(config(tmp_path, disk / "recordings")) as watched:
            wait_for(lambda: "Read-only" in watched.states[-1].recording_problem)
            watched.more_poses(60)
            subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
            wait_for(lambda: not watched.states[-1].recording_problem)
            watched.more_poses(60)
            assert watched.no_pose_is_missing()
        assert len(segments(recordings(disk / "recordings")[0])) > 0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_clients_that_flood_cost_no_pose(tmp_path: Path) -> None:
    pytest.importorskip("uvicorn")
    poses, page, over = free_port(), free_port(), threading.Event()
    outputs = OutputsConfig(pose_socket=PoseSocketConfig(True, f"tcp://127.0.0.1:{poses}"))
    security = SecurityConfig(auth="none")
    settings = replace(config(tmp_path), outputs=outputs, page=PageConfig(True, port=page), security=security)
    answers = list[int]()

    def command() -> None:
        headers = {"Content-Type": "application/json", "X-Stereo-Sfm": "1"}
        asked = urllib.request.Request(f"http://127.0.0.1:{page}/api/command/mark", b"{}", headers)
        while not over.wait(0.002):
            try:
                answers.append(urllib.request.urlopen(asked, timeout=5).status)
            except urllib.error.HTTPError as error:
                answers.append(error.code)
            except OSError:
                pass

    with running(settings) as watched, ExitStack() as connections:
        threads = [threading.Thread(target=command) for _ in range(4)]
        for thread in threads:
            thread.start()
        wait_for(lambda: len(answers) > 20)
        for _ in range(100):  # none reads
            with suppress(OSError):
                connections.enter_context(socket.create_connection(("127.0.0.1", poses), 1.0))
        watched.more_poses(150)
        over.set()
        for thread in threads:
            thread.join()
        assert watched.no_pose_is_missing() and watched.states[-1].state == ServiceState.RUNNING
        assert watched.service.status().data["health"]["restarts"] == 0
    assert answers.count(429) > answers.count(200) > 0


@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a small disk")
def test_a_disk_that_others_fill(tmp_path: Path) -> None:
    with small_disk(tmp_path) as disk:
        settings = config(tmp_path, disk / "recordings")
        settings = replace(settings, recording=replace(settings.recording, min_free_gb=0.02))
        with running(settings) as watched:
            filler = disk / "somebody"
            fill(filler)
            wait_for(lambda: watched.states[-1].state == ServiceState.DISK_FULL)
            watched.more_poses(60)
            filler.unlink()
            wait_for(lambda: watched.states[-1].state == ServiceState.RUNNING)
            watched.more_poses(60)
            assert watched.no_pose_is_missing()
        (folder,) = recordings(disk / "recordings")
        logged = set[int]()
        for segment in segments(folder):
            with LogReader(segment.poses) as reader:
                logged |= {record.sequence for record in reader.messages([topics.FRAME])}
        assert set(range(1, len(watched.poses) - 1)) - logged == set()


def fill(path: Path) -> None:
    with path.open("wb") as file:
        try:
            while True:
                os.write(file.fileno(), bytes(1 << 16))
        except OSError:
            return


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with running(config(tmp_path, tmp_path / "file" / "recordings")) as watched:
        wait_for(lambda: watched.states[-1].recording_problem)
        assert "cannot record to" in watched.states[-1].recording_problem
        assert watched.states[-1].state == ServiceState.RUNNING  # and no advice about disk space
        watched.more_poses()
        assert watched.no_pose_is_missing()


def serve(tmp_path: Path) -> subprocess.Popen[str]:
    options = {
        "source.spec": DEMO,
        "source.repeat": "true",
        "map.folder": tmp_path / "store",
        "map.save_every_min": 0.05,
        "recording.folder": tmp_path / "recordings",
        "recording.mode": "full",
    }
    arguments = [part for name, value in options.items() for part in ("--set", f"{name}={value}")]
    command = [sys.executable, "-m", "stereo_sfm.cli", "serve", "-v", *arguments]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def said(process: subprocess.Popen[str], text: str) -> str:
    assert process.stderr is not None
    for line in process.stderr:
        if text in line:
            return line
    raise AssertionError(f"it never said '{text}'")


def test_kill_9_of_the_service_leaves_no_process_and_loses_nothing(tmp_path: Path) -> None:
    process = serve(tmp_path)
    said(process, "is saved")
    said(process, "is saved")
    children = psutil.Process(process.pid).children(recursive=True)
    assert len(children) >= 6
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(children, timeout=STOP_S)
    assert not alive
    assert len(load_map(tmp_path / "store")) > 0
    (folder,) = recordings(tmp_path / "recordings")
    with open_source(folder) as source:
        assert sum(1 for _ in source) > 30
    again = serve(tmp_path)
    said(again, "recognised")
    began = time.monotonic()
    again.send_signal(signal.SIGTERM)
    said(again, "SIGTERM received")
    assert again.wait(STOP_S + 1.0) == 0 and time.monotonic() - began < STOP_S
    load_map(tmp_path / "store")


def test_a_computer_that_was_suspended_goes_on(tmp_path: Path) -> None:
    """Every process stands still for a while; the watchdogs do not take that for a hung stage."""
    process = serve(tmp_path)
    said(process, "is saved")
    everything = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
    for other in everything:
        other.suspend()
    time.sleep(5.0)
    for other in everything:
        other.resume()
    lines = list[str]()
    assert process.stderr is not None
    while sum("is saved" in line for line in lines) < 2:
        lines.append(process.stderr.readline())
    process.send_signal(signal.SIGTERM)
    lines += process.stderr.readlines()
    assert process.wait(PATIENCE_S) == 0
    assert not [line for line in lines if "started again" in line or "does not respond" in line]


def test_a_mistake_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "stereo_sfm.cli", "serve", "--set", f"source.spec={tmp_path / 'none.mcap'}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
