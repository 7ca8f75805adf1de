"""Recorded paths in the simulated store, the supermarket around them, and its nightly changes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.drivers.sim.drives import FORWARD
from stereo_sfm.drivers.sim.market import CLEAR, GAIT, made_up_paths, plan, session_path
from stereo_sfm.drivers.sim.paths import RobotPath, joined, read_paths, robot_path
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.sim.world import Layout, build_world
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.trajectories import write_tum
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, Trajectory


@pytest.fixture(autouse=True)
def _made_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STEREO_SFM_DATA", raising=False)
    plan.cache_clear()


def curve(turn: float = 1.2) -> tuple[F64, F64]:
    """Times and x, y, heading of three metres in an aisle that turn by some radians."""
    t = np.linspace(0, 4, 81)
    heading = turn * t / 4
    step = 0.75 * 0.05 * np.column_stack([np.cos(heading), np.sin(heading)])
    return t, np.column_stack([np.array([1.0, 3.5]) + np.cumsum(step, axis=0), heading])


def poses_of(course: F64, body: F64) -> F64:
    """world_T_body of bodies mounted on the robot with rotation robot_R_body."""
    turn = se3.so3_exp(course[:, 2:] * np.array([0.0, 0.0, 1.0]))
    return se3.from_rotation_translation(turn @ body, np.column_stack([course[:, :2], np.full(len(course), 0.4)]))


@pytest.mark.parametrize("turn", [0.05, 1.2, -2.8])
def test_paths_are_the_same_from_a_robot_and_from_its_camera_in_either_world(turn: float) -> None:
    t, course = curve(turn)
    stamps = np.round(t * 1e9).astype(np.int64)
    begin = se3.inverse(poses_of(course, FORWARD)[0])
    for poses, true in (
        (poses_of(course, np.eye(3)), course),
        (poses_of(course, FORWARD), course),
        (begin @ poses_of(course, FORWARD), course - course[0]),
    ):
        path = robot_path(Trajectory(stamps, poses))
        assert np.abs(path.course - true).max() < 1e-9
        assert path.seconds == pytest.approx(t)


def test_a_tum_file_is_driven(tmp_path: Path) -> None:
    t, course = curve()
    write_tum(tmp_path / "path.txt", Trajectory(np.round(t * 1e9).astype(np.int64), poses_of(course, np.eye(3))))
    with open_source(f"sim:demo?path={tmp_path / 'path.txt'}&vibration=0&size=64x60&imu=ideal") as source:
        assert isinstance(source, SimSource) and source.ground_truth is not None
        assert source.drive.duration == pytest.approx(5.0, abs=0.1)
        at = source.drive.poses(1.0 + t)[15:-15]
        assert np.abs(at[:, :2, 3] - course[15:-15, :2]).max() < 0.1  # smoothed
        ahead = np.arctan2(at[:, 1, 2], at[:, 0, 2])
        assert np.abs(ahead - course[15:-15, 2]).max() < 0.02
        assert source.frame(30).left.std() > 10
    with open_source(f"sim:demo?path={tmp_path / 'path.txt'}&speed=0.5&length=1.0") as source:
        assert source.ground_truth is not None
        assert source.ground_truth.length == pytest.approx(1.0, abs=0.2)
        assert source.frame_count == pytest.approx(30 * (1.0 + 1.0 / 0.5), abs=3)


def test_a_path_through_a_shelf_is_refused(tmp_path: Path) -> None:
    t, course = curve(0.0)
    write_tum(
        tmp_path / "path.txt",
        Trajectory(np.round(t * 1e9).astype(np.int64), poses_of(course - [0, 0.5, 0], np.eye(3))),
    )
    with pytest.raises(StereoSfmError, match="into a wall or a shelf"):
        open_source(f"sim:demo?path={tmp_path / 'path.txt'}")


def test_sessions_of_a_market_file_are_read(tmp_path: Path) -> None:
    rows = "\n".join(f"{1563003603 + k}.5 {k} 2 0 0 0 0.7071068 0.7071068" for k in range(4))
    (tmp_path / "gt.txt").write_text(f"scene: market\nframe: base_link\n\nseq: 1\n{rows}\nseq: 2\n{rows}\n")
    first, second = read_paths(tmp_path / "gt.txt")
    assert first.course == pytest.approx(second.course)
    assert first.seconds.tolist() == [0, 1, 2, 3] and first.length == pytest.approx(3)
    assert first.course[:, 2] == pytest.approx(np.pi / 2)
    (tmp_path / "bad.txt").write_text("seq: 1\n1 2\n")
    with pytest.raises(StereoSfmError, match="session 1"):
        read_paths(tmp_path / "bad.txt")


def test_a_market_has_the_size_and_its_paths_are_free() -> None:
    market, paths = plan("")
    assert market.room[0] * market.room[1] > 5000
    assert sum(x1 - x0 for x0, x1, _ in market.gondolas) > 40 * 12  # metres of gondolas, two shelves each
    assert len(market.checkouts) >= 5 and len(paths) == 3
    course = joined(list(paths)).course
    camera = course[:, :2] + GAIT.ahead * np.column_stack([np.cos(course[:, 2]), np.sin(course[:, 2])])
    at = np.concatenate([course[:, :2], camera])
    assert at.min() > 1 and (at < np.array(market.room[:2]) - 1).all()
    beside = 0
    for x0, x1, y in market.gondolas:
        off = np.maximum(np.maximum([x0, y - 0.55] - at, at - [x1, y + 0.55]), 0)
        nearest = np.linalg.norm(off, axis=1).min()
        assert nearest > CLEAR - 0.2
        beside += nearest < 2.5
    assert beside > 20


def test_a_long_drive_goes_on_with_the_next_session() -> None:
    paths = tuple(made_up_paths())
    rng = np.random.default_rng(0)
    assert session_path(paths, 1, 0.0, rng) is not paths[0]
    assert session_path(paths, 1, 0.0, rng).length == paths[1].length
    long = session_path(paths, 0, 600.0, rng)
    assert long.length > 600
    speed = np.linalg.norm(np.diff(long.course[:, :2], axis=0), axis=1) / np.diff(long.seconds)
    assert speed.max() < 1.5 and (np.diff(long.seconds) > 0).all()
    assert np.abs(np.diff(long.course[:, 2]) / np.diff(long.seconds)).max() < 3
    later = session_path(paths, 3, 0.0, rng)
    off = np.linalg.norm(later.course[:, :2] - paths[0].course[:, :2], axis=1)
    assert 0.01 < off.min() <= off.max() < 0.31


def test_paths_are_joined_the_short_way_round() -> None:
    a = RobotPath(np.array([0.0, 1.0]), np.array([[0, 0, 0], [1, 0, 3.0]]))
    b = RobotPath(np.array([0.0, 1.0]), np.array([[1, 1, -3.0], [1, 2, -3.0]]))
    both = joined([a, b])
    assert both.course[:, 2] == pytest.approx([0, 3.0, 2 * np.pi - 3, 2 * np.pi - 3])
    assert both.seconds == pytest.approx([0, 1, 2.25, 3.25])


def test_each_night_exchanges_its_share_of_the_rows() -> None:
    layout = Layout(gondolas=1, gondola_length=3.0, products=30)
    days = [build_world(layout, 0, 0.1, n) for n in (1, 2, 12)]
    rows = [d.facings_i[:, 0] for d in days]
    assert all((d.facings == days[0].facings).all() for d in days)
    assert 0.04 < (rows[0] != rows[1]).mean() < 0.16
    assert 0.5 < (rows[0] != rows[2]).mean() < 0.85  # 1 - 0.9^11
    assert (build_world(layout, 0, 0.1, 2).facings_i == days[1].facings_i).all()


@pytest.mark.slow
def test_a_market_is_rendered_in_bounded_memory() -> None:
    with open_source("sim:market?size=212x200") as source:
        assert isinstance(source, SimSource)
        assert sum(a.nbytes for a in source.world) < 300e6
        for k in (0, 1500, 3000):
            image = source.frame(k)
            assert image.left.std() > 5
        at = source.drive.poses(np.arange(0, source.drive.duration, 0.1))[:, :3, 3]
        for block in source.world.blocks:
            gap = np.linalg.norm(np.maximum(np.maximum(block[:3] - at, at - block[3:]), 0), axis=1)
            assert gap.min() > 0.7
