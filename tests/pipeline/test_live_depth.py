"""Live depth in the pipeline: the same bits in every wiring, and no pose waits for it."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from multiprocessing import Pipe
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.config import load
from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.log import topics
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.recorded import read_run
from stereo_sfm.pipeline import stage_graph
from stereo_sfm.pipeline.capture import FreeSlots
from stereo_sfm.pipeline.channels import Inbox
from stereo_sfm.pipeline.depth_stage import IDLE, make_depth
from stereo_sfm.pipeline.inline import run_inline
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.types import LiveDepth
from tests.pipeline.test_pipeline import SlidingWall, inline_log, same

LIVE = load(None, ["tracker.max_features=150", "pipeline.update_lag_frames=4", "dense.live=true", "dense.rate_hz=6.1"])


class Kept:
    """A sink for live depth."""

    def __init__(self) -> None:
        self.got: list[LiveDepth] = []

    def put(self, message: object) -> None:
        if isinstance(message, LiveDepth):
            self.got.append(message)


def depths(path: Path) -> list[int]:
    with LogReader(path) as reader:
        return [record.sequence for record in reader.messages((topics.LIVE_DEPTH,))]


def test_inline_processes_and_replay_have_the_same_depth(tmp_path: Path) -> None:
    inline_log(tmp_path / "a.mcap", SlidingWall(40), LIVE)
    assert depths(tmp_path / "a.mcap") == [0, 5, 10, 15, 20, 25, 30, 35]
    with ProcessRun(MadeSource.of(SlidingWall, 40), LIVE, log=LogOptions(tmp_path / "b.mcap", "none"), delays=1) as run:
        assert len(list(run)) == 40
    assert same(tmp_path / "a.mcap", tmp_path / "b.mcap") == []


def test_a_realtime_run_is_repeated_with_its_own_images(tmp_path: Path) -> None:
    options = LogOptions(tmp_path / "live.mcap", "none")
    with ProcessRun(MadeSource.of(SlidingWall, 40, slow_s=0.03), LIVE, log=options, realtime=True) as run:
        tracked = [frame.frame_id for frame in run]
    with LogReader(tmp_path / "live.mcap") as reader:
        chosen = read_run(reader).depth_frames
    assert chosen and chosen <= set(tracked)
    kept = Kept()
    images = SlidingWall(40)
    for _ in run_inline(images, LIVE, [kept], depth_frames=chosen):
        pass
    assert {live.frame_id for live in kept.got} == chosen


def test_only_an_idle_process_gets_a_live_image_and_a_dead_one_holds_nothing() -> None:
    (from_tracker, tracker), (from_log, log), (from_depth, depth) = (Pipe(duplex=False) for _ in range(3))
    slots = FreeSlots(1, from_tracker, from_log, from_depth)

    def take() -> int:
        found = slots.take(block=False)
        assert found is not None
        tracker.send(found[0])
        log.send(found[0])
        return found[0]

    assert not slots.lend(take(), busy=False), "it still loads its code"
    depth.send(IDLE)
    assert slots.lend(take(), busy=False)
    assert slots.take(block=False) is None, "it has not copied the image"
    depth.send(0)
    assert not slots.lend(take(), busy=False), "it computes"
    depth.send(IDLE)
    assert slots.lend(take(), busy=False)
    depth.close()
    assert not slots.lend(take(), busy=True)
    from_tracker.close()


def never(to_main: object, control: object, images: object, release: object) -> None:
    """Takes its set-up and hangs."""
    Inbox[object](control).take()  # type: ignore[arg-type]
    signal.pause()


def dying(to_main: object, control: object, images: object, release: object) -> None:
    """Dies with the first image."""
    Inbox[object](images).take()  # type: ignore[arg-type]
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("body", [dying, pytest.param(never, marks=pytest.mark.slow)])
def test_poses_go_on_whatever_depth_does(
    body: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(stage_graph.depth_stage, "run_depth", body)
    log = LogOptions(tmp_path / "run.mcap", "none")
    config = replace(LIVE, pipeline=replace(LIVE.pipeline, ring_slots=3))
    with ProcessRun(MadeSource.of(SlidingWall, 30, slow_s=0.05), config, log=log, realtime=True) as run:
        frames = 0
        for _ in run:
            frames += 1
            if frames == 25 and body is never:
                run.stop()
    assert frames >= 25
    if body is dying:
        assert "live depth ended: its process was killed by SIGKILL; the run goes on" in caplog.text
        with LogReader(tmp_path / "run.mcap") as reader:
            assert reader.truncated == ""


def test_a_camera_without_a_pair_is_told_and_tracked(caplog: pytest.LogCaptureFixture) -> None:
    rig = SlidingWall(1).rig
    assert make_depth(LIVE, replace(rig, right=None, left_T_right=np.eye(4))) is None
    assert "live depth needs two cameras" in caplog.text
    assert make_depth(load(), rig) is None
