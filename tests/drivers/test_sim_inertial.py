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
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.preintegration import GRAVITY, preintegrate
from stereo_sfm.types import ImuSamples


def sim(**options: object) -> SimSource:
    scene = dataclasses.replace(SCENES["loop"], layout=Layout(gondolas=2, gondola_length=5.0, products=40))
    return SimSource("loop", scene, read_options(SimOptions, "sim", {"size": "106x100", **options}))


def sampled(source: SimSource, frames: int) -> ImuSamples:
    parts = [source.frame(k).imu for k in range(frames)]
    return ImuSamples.joined([p for p in parts if p is not None])


WAYS: dict[str, dict[str, object]] = {
    "smooth": {},
    "thresholds": {"thresholds": 12},
    "ramps": {"ramps": 3},
    "pushed": {"pushed": "3-9"},
    "spot turns": {"spot_turns": True},
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("begin", [0.5, 5.0])
@pytest.mark.parametrize("way", WAYS)
def test_integrating_exact_samples_gives_the_pose(way: str, seed: int, begin: float) -> None:
    drive = sim(seed=seed, **WAYS[way]).drive
    sensor = InertialSensor("ideal", drive, np.random.default_rng(0))
    dt, n = 1e-4, 30_000  # so fine that the rule of integration does not show
    seconds = begin + (np.arange(n) + 0.5) * dt
    gyro, accel = sensor.exact(seconds)
    motion = preintegrate(np.full(n, dt), gyro, accel, np.zeros(3), np.zeros(3), 1e-4, 1e-3)
    h = 1e-5
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


@pytest.mark.parametrize("name", ["t265", "oak", "bno086"])
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


def test_the_robot_climbs_thresholds_and_ramps() -> None:
    flat, uneven = sim(vibration=0, seed=1), sim(vibration=0, seed=1, thresholds=8, ramps=1)
    seconds = np.arange(0.0, flat.drive.duration, 0.01)
    before, after = flat.drive.poses(seconds), uneven.drive.poses(seconds)
    tilt = np.degrees(np.arcsin(after[:, 2, 2]) - np.arcsin(before[:, 2, 2]))
    lift = after[:, 2, 3] - before[:, 2, 3]
    assert 0.5 < tilt.max() < 8 and -8 < tilt.min() < -0.5  # up, and down again
    assert 0.02 < lift.max() < 0.15 and lift.min() > -0.01
    assert abs(tilt[seconds < 1]).max() < 1e-9 and abs(lift[seconds < 1]).max() < 1e-9
    np.testing.assert_allclose(after[:, :2, 2], before[:, :2, 2], atol=0.02)  # the heading is the same


def test_a_hand_pushes_for_a_while() -> None:
    alone, pushed = sim(vibration=0), sim(vibration=0, pushed="4-7")
    off = np.linalg.norm(
        np.subtract(*(s.drive.poses(np.arange(0.0, 12.0, 0.01))[:, :3, 3] for s in (pushed, alone))), axis=1
    )
    assert off[:250].max() < 1e-4 and off[850:].max() < 1e-4 and 0.05 < off[400:700].max() < 0.2


def test_it_turns_on_the_spot() -> None:
    drive = sim(vibration=0, spot_turns=True).drive
    seconds = np.arange(0.0, drive.duration, 0.01)
    speed = np.linalg.norm(drive.course(seconds, 1)[:, :2], axis=1)
    turning = np.abs(drive.course(seconds, 1)[:, 2])
    assert turning.max() > 0.4 and speed[turning > 0.3].max() < 0.02 and turning[speed > 0.3].max() < 0.01


def test_a_recorded_path_has_its_own_turns() -> None:
    with pytest.raises(StereoSfmError, match="leave spot_turns away"):
        open_source("sim:market?spot_turns=on")
