"""A robot that stands: noticed by all sensors together, and its pose held."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.config import Config
from stereo_sfm.drivers.source import open_source
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.tracking.inertial.rest import HELD, Rest
from stereo_sfm.types import F64
from tests.tracking.test_wheels import Drive

SENSORS = ({"imu": "t265"}, {"imu": "oak"}, {"wheel": "differential"}, {"imu": "t265", "wheel": "twist"})


def held(drive: Drive, seconds: float) -> list[F64]:
    """Poses of the images until a time, each a third of a millimetre off; every second new points are seen from them,
    with that error."""
    poses: list[F64] = []
    offset, rng = np.eye(4), np.random.default_rng(1)
    while drive.next / 15 < seconds:
        k, stamp = drive.next, drive.source.stamp_ns(drive.next)
        drive.feed()
        seen = offset @ drive.odom[k] @ se3.exp(rng.normal(0, 1, 6) * [3e-4, 3e-4, 3e-4, 5e-5, 5e-5, 5e-5])
        poses.append(drive.sensors.settled(stamp, seen))
        drive.sensors.accept(stamp, poses[-1])
        if k % 15 == 0:
            offset = poses[-1] @ se3.inverse(drive.odom[k])
    return poses


@pytest.mark.parametrize("options", SENSORS)
def test_minutes_at_rest(options: dict[str, object]) -> None:
    drive = Drive({**options, "rest": 130.0, "vibration": 0.0})
    poses = held(drive, 120.0)
    off = np.array([se3.log(se3.inverse(poses[20]) @ p) for p in poses[20:]])
    np.testing.assert_array_equal(poses[60], poses[-1])
    assert np.linalg.norm(off[:, :3], axis=1).max() < 2e-3
    assert np.degrees(np.linalg.norm(off[:, 3:], axis=1).max()) < 0.02


@pytest.mark.parametrize("options", SENSORS)
def test_a_robot_that_sets_off_is_released(options: dict[str, object]) -> None:
    drive = Drive({**options, "rest": 3.0, "vibration": 0.0})
    poses = held(drive, 8.0)
    moved = [float(np.linalg.norm(p[:3, 3] - poses[0][:3, 3])) for p in (poses[-1], drive.odom[119])]
    assert moved[1] > 2.0 and abs(moved[0] - moved[1]) < 0.008


def test_slow_driving_is_not_rest() -> None:
    """Two centimetres a second, where the T265 took six metres for half a metre (librealsense 3970)."""
    drive = Drive({"imu": "t265", "wheel": "differential", "speed": 0.02, "length": 0.4, "vibration": 0.0})
    poses = held(drive, 20.0)
    true = np.linalg.norm(drive.odom[299][:3, 3] - drive.odom[30][:3, 3])
    assert true > 0.25 and abs(np.linalg.norm(poses[299][:3, 3] - poses[30][:3, 3]) / true - 1) < 0.01


def test_images_that_move_are_believed_although_the_sensors_stand() -> None:
    """Pushed on a trolley: no wheel turns, and an even speed is no acceleration."""
    rest, poses = Rest(), []
    for k in range(60):
        pose = se3.exp(np.array([0, 0, 0.004 * max(k - 30, 0), 0, 0, 0]))
        poses.append(pose)
        found = rest.settled(k * 66_000_000, pose, lambda: True)
        assert np.linalg.norm(found[:3, 3] - pose[:3, 3]) <= HELD[0]
    np.testing.assert_array_equal(found, poses[-1])


@pytest.mark.slow
def test_a_camera_at_rest_stays_where_it_is() -> None:
    """The whole tracker before a simulated shelf, with the noise of the T265's images."""
    with open_source(
        "sim:loop?size=212x200&rest=60&vibration=0&imu=t265&wheel=differential&frames=200&rate=5"
    ) as source:
        tracker = make_tracker(Config(), source.rig)
        poses = [tracker.step(image)[0].odom_T_cam for image in source]
    off = np.array([se3.log(se3.inverse(poses[10]) @ p) for p in poses[10:]])
    assert np.linalg.norm(off[:, :3], axis=1).max() < 2e-3
    assert np.degrees(np.linalg.norm(off[:, 3:], axis=1).max()) < 0.02
