"""The camera's tilt over the sessions of a service."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.service.outputs.robot_axes import RobotAxes
from stereo_sfm.service.poses import HostClock, PoseConverter
from stereo_sfm.service.robot_mounting import RobotMounting
from stereo_sfm.types import Frame, Keyframe, Observations, TrackState
from tests.maps.test_mounting import drive

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


def test_without_a_map_the_tilt_is_measured_and_not_kept(tmp_path: Path) -> None:
    mounting = RobotMounting()
    mounting.begin(RIG, None)
    assert sum(mounting.keyframe(k) is not None for k in drive(0.1, 4.0, 0.0, floor=False)) == 1
    assert not list(tmp_path.iterdir())
