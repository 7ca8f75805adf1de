"""The simulated inertial sensor against the exact poses of its drive."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereo_sfm.drivers.options import read_options
from stereo_sfm.drivers.sim.inertial import GRADES, RATE_HZ, InertialSensor
from stereo_sfm.drivers.sim.options import SimOptions
from stereo_sfm.drivers.sim.scenes import SCENES
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.sim.world import Layout
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.preintegration import GRAVITY, preintegrate
from stereo_sfm.types import ImuSamples


def sim(**options: object) -> SimSource:
    scene = dataclasses.replace(SCENES["loop"], layout=Layout(gondolas=2, gondola_length=5.0, products=40))
    return SimSource("loop", scene, read_options(SimOptions, "sim", {"size": "106x100", **options}))


def sampled(source: SimSource, frames: int) -> ImuSamples:
    parts = [source.frame(k).imu for k in range(frames)]
    return ImuSamples.joined([p for p in parts if p is not None])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("begin", [0.5, 5.0])
def test_integrating_exact_samples_gives_the_pose(seed: int, begin: float) -> None:
    drive = sim(seed=seed).drive
    sensor = InertialSensor("ideal", drive, np.random.default_rng(0))
    dt, n = 1e-4, 30_000  # so fine that the rule of integration does not show
    seconds = begin + (np.arange(n) + 0.5) * dt
    gyro, accel = sensor.exact(seconds)
    motion = preintegrate(np.full(n, dt), gyro, accel, np.zeros(3), np.zeros(3), 1e-4, 1e-3)
    h = 1e-4
    start, end = drive.poses(np.array([begin, begin + n * dt])) @ sensor.imu.left_T_imu
    speed = np.diff((drive.poses(begin + np.array([-h, h])) @ sensor.imu.left_T_imu)[:, :3, 3], axis=0)[0] / (2 * h)
    t = motion.seconds
    position = start[:3, 3] + speed * t - [0, 0, 0.5 * GRAVITY * t * t] + start[:3, :3] @ motion.position
    np.testing.assert_allclose(start[:3, :3] @ motion.rotation, end[:3, :3], atol=1e-6)
    np.testing.assert_allclose(position, end[:3, 3], atol=1e-6)


def test_samples_arrive_with_the_frame_that_ends_their_interval() -> None:
    source = sim(imu="t265", imu_offset_ms=12)
    samples = sampled(source, 31)
    assert source.rig.imu is not None and source.rig.imu.offset_s == 0.012
    np.testing.assert_allclose(np.diff(samples.stamp_ns), 1e9 / RATE_HZ, atol=1)
    for k in (1, 30):
        part = source.frame(k).imu
        assert part is not None
        seconds = part.stamp_ns * 1e-9 - 0.012
        assert source.stamp_ns(k - 1) * 1e-9 < seconds[0] and seconds[-1] <= source.stamp_ns(k) * 1e-9
    after_a_drop = source.frame(30, dropped_before=29).imu
    assert after_a_drop is not None
    np.testing.assert_array_equal(after_a_drop.stamp_ns, samples.stamp_ns[samples.stamp_ns > source.stamp_ns(0) + 12e6])


@pytest.mark.parametrize("name", ["t265", "oak"])
def test_noise_is_as_in_the_data_sheet_and_the_calibration_corrects_its_part(name: str) -> None:
    drive, grade = sim().drive, GRADES[name]
    truth: list[float] = []
    for seed in range(12):
        sensor = InertialSensor(name, drive, np.random.default_rng(seed))
        samples = sensor.samples(0.0, 10.0, 0)
        gyro, accel = sensor.imu.correct(samples.gyro, samples.accel)
        exact = sensor.exact(samples.stamp_ns * 1e-9)
        for error, noise, bias in (
            (gyro - exact[0], grade.gyro_noise, grade.gyro_bias),
            (accel - exact[1], grade.accel_noise, grade.accel_bias),
        ):
            white = np.diff(error, axis=0).std() / np.sqrt(2 * RATE_HZ)
            assert white == pytest.approx(noise, rel=0.05)
            truth.extend(error.mean(0) / bias)
    assert np.sqrt(np.mean(np.square(truth))) == pytest.approx(1.0, rel=0.3)


def test_without_an_imu_the_images_are_the_same_bits() -> None:
    plain, with_imu = sim(), sim(imu="oak")
    assert plain.frame(70).imu is None and plain.rig.imu is None
    np.testing.assert_array_equal(plain.frame(70).left, with_imu.frame(70).left)
    np.testing.assert_array_equal(plain.pose(70), with_imu.pose(70))
    assert se3.inverse(with_imu.rig.imu.left_T_imu)[:3, 3].any() if with_imu.rig.imu else False
