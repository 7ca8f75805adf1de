"""A run whose processes were started before it."""

from __future__ import annotations

import time

import psutil

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.pipeline.standby import Standby
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


def test_a_standby_that_died_is_known_and_ends() -> None:
    standby = Standby(Config(), SlidingWall(1).rig)
    pids = standby.stages.pids
    psutil.Process(pids["tracker"]).kill()
    until = time.monotonic() + 60.0
    while standby.alive:
        assert time.monotonic() < until
        time.sleep(0.01)
    standby.close()
    assert not any(psutil.pid_exists(pid) for pid in pids.values())
