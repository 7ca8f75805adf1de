"""The tracker's sensors with a calibration that is corrected on the way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereo_sfm.calib.sensor_terms import with_sensor_terms
from stereo_sfm.config import Config
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.inertial.motion_sensors import MotionSensors
from stereo_sfm.types import SensorUpdate, StereoImage
from tests.sensor_drive import SensorDrive, miscalibrated

NOTHING = np.zeros((1, 1), np.uint8)
SMALL = np.diag(np.full(6, 1e-8))
TURN, OFFSET_S, RADIUS = np.radians([2.0, -1.5, 1.0]), 0.02, 0.03


def correction() -> SensorUpdate:
    wheel = np.array([1 / (1 + RADIUS) - 1, 0, 0, 0, 0, 0, 0, 0])
    imu = np.append(-TURN, OFFSET_S)
    return SensorUpdate(1, 0, 0, imu, np.full(4, 1e-3), wheel, np.full(8, 1e-3), "")


def step(of: SensorDrive, sensors: MotionSensors, k: int, seen: bool = True) -> None:
    imu, wheel = of.source.sampled(k)
    sensors.feed(StereoImage(k, int(of.stamp_ns[k]), NOTHING, imu=imu, wheel=wheel))
    if seen:
        sensors.corrected(int(of.stamp_ns[k]), of.poses[k], SMALL)
        sensors.accept(int(of.stamp_ns[k]), of.poses[k])


def off_mm(of: SensorDrive, sensors: MotionSensors, first: int, last: int) -> float:
    """Error of the pose after some images without a pose."""
    for k in range(first, last):
        step(of, sensors, k, seen=False)
    bridge = sensors.bridge(int(of.stamp_ns[last - 1]))
    assert bridge is not None
    return 1e3 * float(np.linalg.norm((se3.inverse(bridge[0]) @ of.poses[last - 1])[:3, 3]))


def test_sensors_go_on_with_a_corrected_calibration() -> None:
    of = SensorDrive(0, wheel="differential", wheel_grade="ideal")
    true, start = of.source.rig, miscalibrated(of.source.rig, TURN, -OFFSET_S, RADIUS)
    config = Config().tracker
    errors: dict[str, float] = {}
    for name, rig in (("true", true), ("wrong", start), ("corrected", start)):
        sensors = MotionSensors.of(config, rig)
        assert sensors is not None
        for k in range(200):
            if name == "corrected" and k == 60:
                sensors.use(correction(), with_sensor_terms(rig, correction()))
            step(of, sensors, k)
        errors[name] = off_mm(of, sensors, 200, 230)
    assert errors["corrected"] < 1.5 * errors["true"] + 5 and errors["wrong"] > 2 * errors["corrected"]


def test_an_update_waits_until_the_view_is_free() -> None:
    of = SensorDrive(0, wheel="differential", wheel_grade="ideal")
    sensors = MotionSensors.of(Config().tracker, of.source.rig)
    assert sensors is not None
    for k in range(100):
        step(of, sensors, k)
    sensors.use(correction(), with_sensor_terms(of.source.rig, correction()))
    assert off_mm(of, sensors, 100, 120) < 50  # by the old ones
    step(of, sensors, 120)  # from here on by the new ones, which know nothing yet
    step(of, sensors, 121, seen=False)
    assert not sensors.level(of.poses[121])


def test_samples_and_poses_of_the_images_are_collected_when_asked_for() -> None:
    of = SensorDrive(0, wheel="differential")
    config = Config().tracker
    silent, sensors = (
        MotionSensors.of(config, of.source.rig),
        MotionSensors.of(replace(config, calibrate_sensors=True), of.source.rig),
    )
    assert silent is not None and sensors is not None and silent.samples() is None
    for k in range(20):
        step(of, sensors, k, seen=k != 7)
    taken = sensors.samples()
    assert taken is not None and taken.imu is not None and taken.wheel is not None
    seen = [k for k in range(20) if k != 7]
    np.testing.assert_array_equal(taken.stamp_ns, of.stamp_ns[seen])
    np.testing.assert_array_equal(taken.odom_T_cam, of.poses[seen])
    raw = [of.source.sampled(k)[0] for k in range(20)]
    np.testing.assert_array_equal(taken.imu.gyro, np.concatenate([r.gyro for r in raw if r is not None]))
    again = sensors.samples()
    assert again is not None and not len(again.stamp_ns) and again.imu is None and again.wheel is None
    step(of, sensors, 20)
    sensors.begin(int(of.stamp_ns[20]), np.eye(4))
    begun = sensors.samples()
    assert begun is not None and not len(begun.stamp_ns) and begun.imu is not None
