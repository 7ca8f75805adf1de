"""Inline, processes and replay give equal bits; after any process is killed, the log stays and no process remains."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from multiprocessing import shared_memory
from pathlib import Path

import numpy as np
import psutil
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config, load
from stereo_sfm.drivers.choice import MadeSource, SourceChoice
from stereo_sfm.drivers.source import BaseSource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.log.diff import diff
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.recorded import ended_early, read_run
from stereo_sfm.log.run_log import RunLog
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.maps.folders import MapFolders
from stereo_sfm.maps.saved_map import load_map
from stereo_sfm.pipeline.inline import run_inline
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.processes import ProcessRun, StageDied
from stereo_sfm.pipeline.schedule import Lockstep, Recorded, Schedule
from stereo_sfm.pipeline.threads import VARIABLES, thread_environment
from stereo_sfm.types import Applied, Frame, StereoImage, Trajectory

WIDTH, HEIGHT, BASELINE = 320, 240, 0.1


class SlidingWall(BaseSource):
    """A camera that slides along a textured wall, out and back: exact, quick, and it sees places again."""

    name = "wall"

    def __init__(self, frames: int, fail_at: int = -1, slow_s: float = 0.0) -> None:
        camera = Pinhole(WIDTH, HEIGHT, 200.0, 200.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
        left_T_right = np.eye(4)
        left_T_right[0, 3] = BASELINE
        self.rig = Rig(camera, camera, left_T_right)
        self.frame_count = frames
        self._fail_at, self._slow_s = fail_at, slow_s
        rng = np.random.default_rng(4)
        coarse = rng.uniform(20, 230, (HEIGHT // 4, 1200 // 4))
        wall = np.kron(coarse, np.ones((4, 4)))
        kernel = np.array([1, 4, 6, 4, 1]) / 16
        for axis in (0, 1):
            wall = np.apply_along_axis(lambda r: np.convolve(r, kernel, "same"), axis, wall)
        self._wall = wall

    def __iter__(self) -> Iterator[StereoImage]:
        import time

        count = self.frame_count or 0
        for k in range(count):
            if k == self._fail_at:
                raise RuntimeError("the driver broke")
            time.sleep(self._slow_s)
            x = 4 * min(k, count - k)
            views = [self._wall[:, x + d : x + d + WIDTH].astype(np.uint8) for d in (10, 20)]
            yield StereoImage(k, 1_000_000_000 + k * 33_333_333, *views)


CONFIG = load(None, ["tracker.max_features=150", "pipeline.update_lag_frames=4"])


def inline_log(path: Path, source: SlidingWall, config: Config = CONFIG, schedule: Schedule | None = None) -> None:
    log = RunLog(LogWriter(path), source.rig, config, source="wall", mode="inline", image_format="none")
    for _ in run_inline(source, config, [log], schedule):
        pass
    log.close()


def process_log(path: Path, source: MadeSource, **options: object) -> list[Frame]:
    with ProcessRun(source, CONFIG, log=LogOptions(path, "none"), **options) as run:  # type: ignore[arg-type]
        return list(run)


def same(a: Path, b: Path) -> list[str]:
    with LogReader(a) as left, LogReader(b) as right:
        return [str(d) for d in diff(left, right)]


@pytest.fixture(scope="module")
def inline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("inline") / "run.mcap"
    inline_log(path, SlidingWall(80))
    return path


def test_processes_with_delays_give_the_bits_of_inline(inline: Path, tmp_path: Path) -> None:
    frames = process_log(tmp_path / "run.mcap", MadeSource.of(SlidingWall, 80), delays=1)
    assert len(frames) == 80
    assert same(inline, tmp_path / "run.mcap") == []
    with LogReader(inline) as reader:
        assert len(read_run(reader).applied) >= 3  # the map reached the tracker


def test_blas_has_the_configured_threads_inline_as_between_processes() -> None:
    from threadpoolctl import threadpool_info

    frames = run_inline(SlidingWall(3), CONFIG)
    next(frames)
    assert {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"} == {1}
    frames.close()


def test_a_realtime_run_is_replayed_by_its_recorded_schedule(tmp_path: Path) -> None:
    process_log(tmp_path / "live.mcap", MadeSource.of(SlidingWall, 60, slow_s=0.01), realtime=True, delays=2)
    with LogReader(tmp_path / "live.mcap") as reader:
        run = read_run(reader)
        tracked = {r.sequence for r in reader.messages(["/frame"])}
    assert len(tracked) + sum(d.count for d in run.dropped) == 60

    class Tracked(SlidingWall):
        def __iter__(self) -> Iterator[StereoImage]:
            return (image for image in super().__iter__() if image.frame_id in tracked)

    inline_log(tmp_path / "again.mcap", Tracked(60), schedule=Recorded(run.applied))
    different = [d for d in same(tmp_path / "live.mcap", tmp_path / "again.mcap") if "/dropped" not in d]
    assert different == []


@pytest.mark.parametrize("logged", [True, False])
@pytest.mark.parametrize("killed", [True, False])
def test_a_run_leaves_no_thread(logged: bool, killed: bool, tmp_path: Path) -> None:
    """A service begins again after every fault."""
    before = threading.active_count()
    log = LogOptions(tmp_path / "run.mcap", "none") if logged else None
    with suppress(StageDied), ProcessRun(MadeSource.of(SlidingWall, 30), CONFIG, log=log) as run:
        for k, _ in enumerate(run):
            if k == 10 and killed:
                os.kill(run.pids["mapper"], signal.SIGKILL)
    assert threading.active_count() == before


def frames_in(path: Path) -> int:
    with LogReader(path) as reader:
        return sum(1 for _ in reader.messages(["/frame"]))


def all_end(pids: dict[str, int]) -> bool:
    """Whether the processes end, by stage: a run that is abandoned kills them and does not wait."""
    left = list[psutil.Process]()
    for pid in pids.values():
        with suppress(psutil.NoSuchProcess):
            left.append(psutil.Process(pid))
    return not psutil.wait_procs(left, timeout=10)[1]


@pytest.mark.parametrize(
    "stage", ["tracker", "logger", *(pytest.param(s, marks=pytest.mark.slow) for s in ("capture", "mapper"))]
)
def test_a_killed_stage_ends_the_run_and_leaves_a_log(stage: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run = ProcessRun(MadeSource.of(SlidingWall, 5000, slow_s=0.005), CONFIG, log=LogOptions(path, "none"))
    on_disk, killed = 0, False
    with pytest.raises(StageDied, match=f"the {stage} process was killed by SIGKILL"), run:  # noqa: PT012
        pids = run.pids
        name = run._ring.name if run._ring is not None else ""
        for k, _ in enumerate(run):
            if not killed and k >= 40 and k % 10 == 0:
                on_disk = frames_in(path)
                if killed := on_disk >= 25:
                    os.kill(pids[stage], signal.SIGKILL)
    assert killed
    assert all_end(pids)
    with pytest.raises(FileNotFoundError):
        shared_memory.SharedMemory(name)
    with LogReader(path) as reader:
        assert ended_early(reader) == (stage != "capture")  # what capture had read is tracked and mapped to the end
    assert frames_in(path) >= on_disk


def test_an_error_in_a_stage_comes_back_with_its_traceback(tmp_path: Path) -> None:
    with pytest.raises(StageDied, match="the driver broke"):
        process_log(tmp_path / "run.mcap", MadeSource.of(SlidingWall, 50, fail_at=20))
    with LogReader(tmp_path / "run.mcap") as reader:
        assert sum(1 for _ in reader.messages(["/frame"])) == 20
        assert not ended_early(reader)


def wired(in_processes: bool, source: MadeSource, folders: MapFolders) -> Iterator[Frame]:
    if not in_processes:
        yield from run_inline(source(), CONFIG, folders=folders)
        return
    with ProcessRun(source, CONFIG, folders=folders) as run:
        yield from run


@pytest.mark.parametrize("in_processes", [False, True])
def test_what_a_source_gave_before_it_failed_is_mapped(in_processes: bool, tmp_path: Path) -> None:
    frames: list[Frame] = []
    source, folders = MadeSource.of(SlidingWall, 80, fail_at=60), MapFolders(map_out=tmp_path / "map")
    with pytest.raises((RuntimeError, StageDied), match="the driver broke"):
        frames.extend(wired(in_processes, source, folders))
    assert [f.frame_id for f in frames] == list(range(60))
    assert len(load_map(tmp_path / "map").snapshot.kf_ids) >= 3


@pytest.mark.parametrize("in_processes", [False, True])
def test_the_error_of_the_source_is_reported_without_a_map_to_save(in_processes: bool, tmp_path: Path) -> None:
    source, folders = MadeSource.of(SlidingWall, 80, fail_at=0), MapFolders(map_out=tmp_path / "map")
    with pytest.raises((RuntimeError, StageDied), match="the driver broke"):
        list(wired(in_processes, source, folders))
    assert not (tmp_path / "map").exists()


def test_a_killed_capture_process_loses_no_image_that_it_read(tmp_path: Path) -> None:
    source, folders = MadeSource.of(SlidingWall, 5000, slow_s=0.005), MapFolders(map_out=tmp_path / "map")
    with pytest.raises(StageDied, match="the capture process was killed by SIGKILL"):  # noqa: PT012, SIM117
        with ProcessRun(source, CONFIG, folders=folders) as run:
            for k, _ in enumerate(run):
                if k == 60:
                    os.kill(run.pids["capture"], signal.SIGKILL)
    assert len(load_map(tmp_path / "map").snapshot.kf_ids) >= 3


class StalledWall(SlidingWall):
    """A camera that gives no more images."""

    def __iter__(self) -> Iterator[StereoImage]:
        import time

        for image in super().__iter__():
            if image.frame_id == 20:
                time.sleep(1000)
            yield image


def test_a_stop_works_without_images(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("stereo_sfm.pipeline.processes.STOP_GRACE_S", 0.5)
    folders = MapFolders(map_out=tmp_path / "map")
    with ProcessRun(MadeSource.of(StalledWall, 50), CONFIG, folders=folders) as run:
        frames: list[Frame] = []
        for frame in run:
            frames.append(frame)
            if len(frames) == 20:
                threading.Timer(0.5, run.stop).start()  # as a signal does: while the next message is awaited
    assert len(frames) == 20
    assert len(load_map(tmp_path / "map")) >= 1


def test_a_late_stop_is_not_an_error() -> None:
    with ProcessRun(MadeSource.of(SlidingWall, 5), CONFIG) as run:
        assert len(list(run)) == 5
    run.stop()


def test_a_stage_that_dies_before_it_is_set_up_is_named(tmp_path: Path) -> None:
    run = ProcessRun(MadeSource.of(SlidingWall, 50), CONFIG, log=LogOptions(tmp_path / "run.mcap", "none"))

    def kill() -> None:
        os.kill(run.pids["tracker"], signal.SIGKILL)
        run._stages.processes["tracker"].join()

    run._opened = kill
    with pytest.raises(StageDied, match="the tracker process was killed by SIGKILL"), run:
        list(run)


def test_the_users_number_of_threads_does_not_reach_the_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "8")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with thread_environment(1):
        assert {os.environ[variable] for variable in VARIABLES} == {"1"}
    assert os.environ["OPENBLAS_NUM_THREADS"] == "8"
    assert "MKL_NUM_THREADS" not in os.environ


def test_a_source_that_cannot_be_opened_is_one_clear_line() -> None:

    with (
        pytest.raises(StereoSfmError, match="no such file or folder: nothing"),
        ProcessRun(SourceChoice("nothing"), CONFIG),
    ):
        pass


def test_stop_finishes_what_is_in_flight(tmp_path: Path) -> None:
    seen = 0
    with ProcessRun(
        MadeSource.of(SlidingWall, 5000, slow_s=0.005), CONFIG, log=LogOptions(tmp_path / "run.mcap", "none")
    ) as run:
        for seen, _ in enumerate(run, 1):
            if seen == 30:
                run.stop()
    assert 30 <= seen < 200
    with LogReader(tmp_path / "run.mcap") as reader:
        assert sum(1 for _ in reader.messages(["/frame"])) == seen


def dues(schedule: Schedule, keyframes: Sequence[int], count: int) -> list[int]:
    out: list[int] = []
    for k in range(count):
        due = schedule.due(k, 10 + k)
        out.extend([k] * (due or 0))
        if k in keyframes:
            schedule.keyframe(k)
    return out


def test_lockstep_applies_an_update_exactly_the_lag_later() -> None:
    assert dues(Lockstep(3), (0, 4, 5), 10) == [3, 7, 8]


def test_a_recorded_schedule_is_followed() -> None:
    assert dues(Recorded([Applied(1, 12), Applied(2, 15), Applied(3, 15)]), (0, 1, 2), 10) == [2, 5, 5]


def test_a_repeat_with_later_keyframes_does_not_wait_for_updates_that_never_come() -> None:
    assert dues(Recorded([Applied(1, 12), Applied(2, 15), Applied(3, 15)]), (0, 8, 9), 10) == [2, 9]


def test_trajectory_of_the_wall_is_right() -> None:
    frames = list(run_inline(SlidingWall(40), CONFIG))
    x = np.array([f.odom_T_cam[0, 3] for f in frames])
    depth = 200 * BASELINE / 10  # the cameras see the wall ten pixels apart
    expected = 4 * np.minimum(np.arange(40), 40 - np.arange(40)) * depth / 200
    assert np.abs(x - expected).max() < 0.002
    assert isinstance(Trajectory(np.arange(40), np.array([f.odom_T_cam for f in frames])).length, float)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_any_process_killed_at_any_time(seed: int, tmp_path: Path) -> None:
    """The log loses at most half a second of frames, and no process remains."""
    rng = np.random.default_rng(seed)
    path, kill_at, seen = tmp_path / "run.mcap", int(rng.integers(5, 120)), 0
    run = ProcessRun(MadeSource.of(SlidingWall, 5000, slow_s=0.005), CONFIG, log=LogOptions(path, "none"))
    with pytest.raises(StageDied, match="was killed by SIGKILL") as died, run:  # noqa: PT012
        pids = run.pids
        stage = sorted(pids.keys() - {"loop"})[int(rng.integers(len(pids) - 1))]  # which starts again
        for seen, _ in enumerate(run, 1):
            if seen == kill_at:
                os.kill(pids[stage], signal.SIGKILL)
    assert died.value.exit_code == 1
    assert all_end(pids)
    with LogReader(path) as reader:
        logged = sum(1 for _ in reader.messages(["/frame"]))
    assert logged >= seen - 15
