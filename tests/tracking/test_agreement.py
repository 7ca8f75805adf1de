"""An IMU counts once the images show that it is right; one that is wrong is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereo_sfm.geometry import se3
from stereo_sfm.tracking.inertial.agreement import SensorUse
from stereo_sfm.tracking.inertial.inertial_motion import InertialMotion
from stereo_sfm.tracking.inertial.wheel_window import WheelWindow
from stereo_sfm.types import ImuSamples
from tests.sensor_drive import SensorDrive
from tests.tracking.test_inertial import Session, follow

SESSION = Session()
GOOD = SESSION.samples()
QUARTER = se3.so3_exp(np.array([0.0, np.pi / 2, 0.0]))
HALVES = np.arange(len(GOOD))[:, None] % 2 == 0
WRONG = {
    "gyro sign": (ImuSamples(GOOD.stamp_ns, -GOOD.gyro, GOOD.accel), "wrong sign"),
    "gravity sign": (ImuSamples(GOOD.stamp_ns, GOOD.gyro, -GOOD.accel), "forces have the wrong sign"),
    "degrees": (ImuSamples(GOOD.stamp_ns, np.degrees(GOOD.gyro), GOOD.accel), "in degrees"),
    "in g": (ImuSamples(GOOD.stamp_ns, GOOD.gyro, GOOD.accel / 9.8), "in g?"),
    "axes": (ImuSamples(GOOD.stamp_ns, GOOD.gyro[:, [1, 2, 0]], GOOD.accel[:, [1, 2, 0]]), "turned by about 120"),
    "turned": (ImuSamples(GOOD.stamp_ns, GOOD.gyro @ QUARTER.T, GOOD.accel @ QUARTER.T), "turned by about 90"),
    "handed": (ImuSamples(GOOD.stamp_ns, GOOD.gyro[:, [1, 0, 2]], GOOD.accel), "left- and right-handed"),
    "late": (GOOD.shifted(60_000_000), "ms off"),
    "clock": (GOOD.shifted(-1_700_000_000_000_000_000), "another clock"),
    "no rotation": (ImuSamples(GOOD.stamp_ns, 0 * GOOD.gyro, GOOD.accel), "no rotation"),
    "halves": (ImuSamples(GOOD.stamp_ns, np.where(HALVES, GOOD.gyro, 0), np.where(HALVES, 0, GOOD.accel)), ""),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_never_counts_and_is_named(wrong: str) -> None:
    samples, text = WRONG[wrong]
    motion = follow(SESSION, 6.0, samples)
    assert motion.use <= SensorUse.MISSING and text in motion.news
    assert motion.link(5_000_000_000, 6_000_000_000) is None and motion.bridge(round(6.05e9)) is None
    expected = se3.exp(np.full(6, 0.1))
    np.testing.assert_array_equal(motion.predict(round(6.05e9), expected), expected)


def test_what_is_right_counts_within_seconds() -> None:
    assert follow(SESSION, 0.3).use == SensorUse.UNKNOWN
    assert follow(SESSION, 1.0).use == SensorUse.ROTATION
    motion = follow(SESSION, 4.0)
    assert motion.use == SensorUse.USED and not motion.news and motion.link(3_000_000_000, 4_000_000_000) is not None


@pytest.mark.parametrize("sign", [1, -1])
def test_a_camera_that_only_stands_shows_nothing(sign: int) -> None:
    class Standing(Session):
        def pose(self, t: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
            return np.eye(4)

    still = Standing()
    samples = still.samples()
    motion = follow(still, 6.0, ImuSamples(samples.stamp_ns, samples.gyro, sign * samples.accel))
    assert motion.use == SensorUse.UNKNOWN and not motion.news


@pytest.mark.parametrize("seed", [0, 1])
def test_on_a_robot_that_turns_about_one_axis_only(seed: int) -> None:
    """The gyroscope cannot show that an IMU is turned about that axis, the accelerometer does."""
    drive = SensorDrive(seed)
    imu = drive.source.rig.imu
    assert imu is not None
    for turned, use in ((0.0, SensorUse.USED), (np.pi, SensorUse.CONTRADICTS)):
        about_y = se3.from_rotation_translation(se3.so3_exp(np.array([0.0, turned, 0.0])), np.zeros(3))
        motion, at = InertialMotion(replace(imu, left_T_imu=about_y @ imu.left_T_imu)), 0
        for stamp_ns, pose in zip(drive.stamp_ns[:90].tolist(), drive.poses, strict=False):
            until = int(np.searchsorted(drive.imu.stamp_ns, stamp_ns, side="right"))
            motion.feed(drive.imu.part(slice(at, until)))
            motion.accept(stamp_ns, pose)
            at = until
        assert motion.use == use


def test_wheels_count_once_they_agree() -> None:
    window, moved = WheelWindow("differential", 0.05), np.eye(4)
    moved[0, 3] = 0.2
    window.add(0.5, moved, moved)
    assert not window.agreed
    window.add(0.5, moved, moved)
    assert window.agreed
    silent = WheelWindow("differential", 0.05)
    for _ in range(20):
        silent.add(0.5, np.eye(4), moved)
        assert not silent.agreed
    assert silent.left_out and silent.silent


def test_wheels_that_turn_the_wrong_way_are_left_out_in_a_turn() -> None:
    window = WheelWindow("differential", 0.05)
    for turn, left_out in ((0.0, False), (0.2, True), (0.2, True)):
        for _ in range(6):
            window.add(0.5, *(se3.exp(np.array([0.2, 0, 0, 0, 0, sign * turn])) for sign in (-1.0, 1.0)))
        assert window.left_out == left_out
