"""A run whose processes were started before it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import psutil
import pytest

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.maps.folders import MapFolders
from stereo_sfm.pipeline import workers
from stereo_sfm.pipeline.capture import SourceInfo
from stereo_sfm.pipeline.channels import Inbox
from stereo_sfm.pipeline.child import Setup, WarmUp
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.pipeline.standby import Standby
from stereo_sfm.timing import Spans
from tests.pipeline.test_pipeline import SlidingWall


def test_a_run_uses_the_processes_that_wait() -> None:
    config, source = Config(), SlidingWall(12)
    standby = Standby(config, source.rig)
    pids = standby.stages.pids
    assert set(pids) == {"capture", "tracker", "mapper", "loop", "optimizer"} and standby.alive
    with ProcessRun(MadeSource.of(SlidingWall, 12), config, standby=lambda: standby) as run:
        assert run.pids == pids
        assert [frame.frame_id for frame in run] == list(range(12))
    assert not any(psutil.pid_exists(pid) for pid in pids.values())


def test_the_tracker_of_a_standby_is_made_before_its_set_up_comes() -> None:
    rig = SlidingWall(1).rig
    info, other = SourceInfo.of(SlidingWall(1)), replace(rig, serial="another")
    for now, used in ((info.rig, True), (other, False)):
        receive, send = multiprocessing.Pipe(duplex=False)
        send.send(WarmUp(Config(), rig))
        send.send(Setup(now, Config(), None, "", "", None, True, MapFolders(), None))
        setup, warm, made = workers._warmed_up(Inbox(receive), Spans())  # pyright: ignore[reportPrivateUsage]
        assert warm and (made is not None) == used and setup.rig.serial == now.serial


def test_a_standby_loads_what_opening_the_source_takes() -> None:
    assert SourceInfo.of(SlidingWall(1), sys.modules.keys() - {"json"}).modules == ("json",)
    receive, send = multiprocessing.Pipe(duplex=False)
    send.send(WarmUp(Config(), SlidingWall(1).rig, ("no_such_module", "colorsys")))
    send.send("the opener")
    sys.modules.pop("colorsys", None)
    assert workers._opener(receive) == "the opener"  # pyright: ignore[reportPrivateUsage]
    assert "colorsys" in sys.modules


@pytest.mark.parametrize("fault", [signal.SIGKILL, signal.SIGSTOP])
def test_a_standby_that_died_or_was_stopped_is_known_and_ends(fault: signal.Signals) -> None:
    standby = Standby(Config(), SlidingWall(1).rig)
    pids = standby.stages.pids
    os.kill(pids["tracker"], fault)
    until = time.monotonic() + 60.0
    while standby.alive:
        assert time.monotonic() < until
        time.sleep(0.01)
    standby.close()
    for process in standby.stages.processes.values():
        process.join(60.0)
    assert not any(psutil.pid_exists(pid) for pid in pids.values())


@pytest.mark.parametrize("first", [False, True])
def test_poses_may_come_before_the_map(first: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot may be moving while its pipeline starts again."""
    run, asked = ProcessRun(MadeSource.of(SlidingWall, 1), Config(), pose_first=first), list[tuple[str, object]]()
    monkeypatch.setattr(type(run._stages), "request", lambda _, *given: asked.append(given))  # pyright: ignore[reportPrivateUsage]
    monkeypatch.setattr(ProcessRun, "_loop", SimpleNamespace(ready=lambda: None))
    run._live, run._not_ready = True, {"tracker", "mapper", "loop", "optimizer"}  # pyright: ignore[reportPrivateUsage]
    run._begin("tracker")  # pyright: ignore[reportPrivateUsage]
    assert (("capture", "go") in asked) == first
    for stage in ("mapper", "loop", "optimizer"):
        run._begin(stage)  # pyright: ignore[reportPrivateUsage]
    assert asked.count(("capture", "go")) == 1
