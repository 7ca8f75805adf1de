"""The camera's tilt over the sessions of a service."""

from __future__ import annotations

import queue
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib.formats.native import write_native
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.service.config import MapConfig, RecordingConfig, RobotConfig, SourceConfig
from stereo_sfm.service.messages import PoseUpdate, Started
from stereo_sfm.service.outputs.robot_axes import RobotAxes
from stereo_sfm.service.poses import HostClock, PoseConverter
from stereo_sfm.service.robot_mounting import RobotMounting
from stereo_sfm.service.service import Service
from stereo_sfm.types import Frame, Keyframe, Observations, TrackState
from tests.maps.test_mounting import drive

DEMO = Path(__file__).parents[2] / "recordings" / "demo.mcap"
RIG = Rig(Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0), serial="camera-1")


def heights(rig: Rig, keyframes: list[Keyframe]) -> list[float]:
    """Metres of the robot above its start, as outputs publish them."""
    axes, poses = RobotAxes(rig), PoseConverter(rig, 1, HostClock())
    frames = [
        Frame(k.frame_id, k.stamp_ns, k.odom_T_cam, np.eye(6), TrackState.OK, "", Observations.empty(), -1, np.eye(4))
        for k in keyframes
    ]
    return [float(axes.pose(poses.frame(frame)).map_T_base[2, 3]) for frame in frames]


def test_poses_are_level_once_the_tilt_is_measured_and_from_the_start_of_the_next_day(tmp_path: Path) -> None:
    keyframes = drive(0.0, 4.0, 0.0, floor=True)
    mounting = RobotMounting()
    assert mounting.begin(RIG, tmp_path / "store") is RIG
    found = [rig for rig in map(mounting.keyframe, keyframes) if rig is not None]
    assert len(found) == 1
    assert abs(heights(RIG, keyframes)[-1]) > 1.2 and max(map(abs, heights(found[0], keyframes))) < 0.06
    again = RobotMounting()
    kept = again.begin(RIG, tmp_path / "store")
    assert max(map(abs, heights(kept, keyframes))) < 0.06
    assert not any(again.keyframe(k) for k in keyframes)  # no second change of the axes
    assert "measured while driving" in (tmp_path / "store.rig.yaml").read_text()


def test_another_camera_and_given_tilts_are_left_alone(tmp_path: Path) -> None:
    mounting, keyframes = RobotMounting(), drive(0.1, 4.0, 0.0, floor=True)
    mounting.begin(RIG, tmp_path / "store")
    for keyframe in keyframes:
        mounting.keyframe(keyframe)
    other = replace(RIG, serial="camera-2")
    assert RobotMounting().begin(other, tmp_path / "store") is other
    given = replace(RIG, body_T_left=se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])))
    mounting = RobotMounting()
    assert mounting.begin(given, tmp_path / "store") is given
    assert not any(mounting.keyframe(k) for k in keyframes)


def test_a_better_tilt_of_yesterday_stays_and_another_one_takes_its_place(tmp_path: Path) -> None:
    def day(pitch: float, count: int) -> tuple[list[Rig], str]:
        mounting = RobotMounting()
        mounting.begin(RIG, tmp_path / "store")
        keyframes = drive(0.1, pitch, 0.0, floor=True, count=count)
        changes = [rig for rig in map(mounting.keyframe, keyframes) if rig is not None]
        return changes, (tmp_path / "store.rig.yaml").read_text()

    changes, long_drive = day(4.0, 200)
    assert len(changes) == 1
    assert day(4.0, 15) == ([], long_drive)  # shorter: it says the same, less surely
    moved, kept = day(5.5, 40)
    assert len(moved) == 1 and kept != long_drive
    assert max(map(abs, heights(moved[0], drive(0.1, 5.5, 0.0, floor=True)))) < 0.06
    old = "".join(line for line in kept.splitlines(True) if "tilt_sigma_deg" not in line)
    (tmp_path / "store.rig.yaml").write_text(old)  # of a version that kept no standard deviations
    assert day(5.5, 40)[0] == []


@pytest.mark.parametrize("sigma", ["[.nan, 1.0]", "[1.0]", "[-1.0, 1.0]", "much"])
def test_a_damaged_tilt_is_measured_anew(sigma: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_native(
        replace(RIG, body_T_left=se3.exp(np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0]))), tmp_path / "store.rig.yaml"
    )
    with (tmp_path / "store.rig.yaml").open("a") as out:
        out.write(f"tilt_sigma_deg: {sigma}\n")
    assert RobotMounting().begin(RIG, tmp_path / "store") is RIG
    assert "the camera's tilt is measured anew" in caplog.text


def test_without_a_map_the_tilt_is_measured_and_not_kept(tmp_path: Path) -> None:
    mounting = RobotMounting()
    mounting.begin(RIG, None)
    assert sum(mounting.keyframe(k) is not None for k in drive(0.1, 4.0, 0.0, floor=False)) == 1
    assert not list(tmp_path.iterdir())
    again = mounting.begin(RIG, None)  # after a stage died
    assert max(map(abs, heights(again, drive(0.1, 4.0, 0.0, floor=True)))) < 0.06
    assert mounting.begin(RIG, tmp_path / "another") is not RIG  # another map, the same robot
    other = replace(RIG, serial="camera-2")
    assert mounting.begin(other, None) is other


@pytest.mark.slow
def test_the_poses_of_a_service_climb_on_the_first_day_only(tmp_path: Path) -> None:
    """In the bundled recording the camera looks down by 4 degrees, and nothing says so."""
    settings = RobotConfig(
        source=SourceConfig(spec=str(DEMO)), map=MapConfig(str(tmp_path / "store")),
        recording=RecordingConfig(folder=str(tmp_path / "recordings")),
    )  # fmt: skip

    def climbed() -> list[float]:
        said = queue.SimpleQueue[Started | PoseUpdate]()
        with Service(settings, outputs={}) as service:
            service.on(Started, said.put)
            service.on(PoseUpdate, said.put)
            assert service.wait(120.0)
        metres, axes = list[float](), RobotAxes(RIG)
        while not said.empty():
            message = said.get()
            if isinstance(message, Started):
                axes = RobotAxes(message.rig)
            else:
                metres.append(float(axes.pose(message).map_T_base[2, 3]))
        return metres

    first = climbed()
    assert max(map(abs, first)) > 0.2 and abs(first[-1]) < 0.1
    assert max(map(abs, climbed())) < 0.05
