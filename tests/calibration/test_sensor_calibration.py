"""Calibration of IMU and wheels while driving: recovery of wrong values, true ones that stay, wrong sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.sensor_terms import with_sensor_terms
from stereo_sfm.calibration.sensor_calibration import SensorCalibration
from stereo_sfm.config import Config, load
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.mapper import Mapper
from stereo_sfm.types import F64, Keyframe, SensorSamples, SensorUpdate
from tests.sensor_drive import FRAMES, THREE_DEGREES, SensorDrive, miscalibrated

EVERY = 15  # images from one keyframe to the next


def drive(seed: int) -> SensorDrive:
    return SensorDrive(seed, imu_offset_ms=20, wheel="differential", wheel_grade="ideal")


def wrong(rig: Rig) -> Rig:
    """20 ms, 3 degrees and 2 % off."""
    return miscalibrated(rig, THREE_DEGREES, 0.0, 0.02)


def keyframe(kf_id: int, stamp_ns: int, pose: F64, samples: SensorSamples | None, submap_id: int = 0) -> Keyframe:
    none = np.zeros((0, 2))
    return Keyframe(
        kf_id, kf_id, stamp_ns, pose, np.zeros(0, np.int64), none, none, np.zeros((0, 3)), np.zeros((0, 32), np.uint8),
        submap_id=submap_id, samples=samples,
    )  # fmt: skip


def keyframes(of: SensorDrive, submap: int | None = None) -> list[Keyframe]:
    """One a second; `submap`: that from which on they belong to another one."""
    out: list[Keyframe] = []
    for n, first in enumerate(range(0, FRAMES, EVERY)):
        rows = slice(first, first + EVERY)
        until = of.stamp_ns[rows][-1]
        parts = [
            s.part(np.flatnonzero((s.stamp_ns > until - 10**9) & (s.stamp_ns <= until)))
            for s in (of.imu, of.wheel)
            if s is not None
        ]
        samples = SensorSamples(of.stamp_ns[rows], of.poses[rows], *parts)  # type: ignore[arg-type]
        other = int(submap is not None and n >= submap)
        out.append(keyframe(n, int(until), of.poses[rows][-1], samples, other))
    return out


def updates(calibration: SensorCalibration, of: list[Keyframe]) -> list[SensorUpdate]:
    return [u for k in of if (u := calibration.add(k, k.kf_id + 1)) is not None]


@pytest.mark.parametrize("seed", range(2))
def test_20_ms_3_degrees_and_2_per_cent_are_found(seed: int) -> None:
    of = drive(seed)
    true, start = of.source.rig, wrong(of.source.rig)
    assert true.imu is not None and true.wheel is not None
    found = updates(SensorCalibration(start), keyframes(of))
    rig = with_sensor_terms(start, found[-1])
    assert rig.imu is not None and rig.wheel is not None
    off = se3.so3_log(rig.imu.left_T_imu[:3, :3].T @ true.imu.left_T_imu[:3, :3])
    assert np.degrees(np.linalg.norm(off)) < 0.1
    assert abs(rig.imu.offset_s - true.imu.offset_s) < 5e-4
    assert np.mean(rig.wheel.radii_m) == pytest.approx(np.mean(true.wheel.radii_m), rel=2e-3)
    np.testing.assert_array_equal(rig.imu.left_T_imu[:3, 3], true.imu.left_T_imu[:3, 3])
    assert 15e9 <= found[0].stamp_ns - of.stamp_ns[0] <= 20e9
    assert "IMU rotation: turned by" in found[0].text and "wheels' scale: -" in found[0].text


@pytest.mark.parametrize("seed", range(3))
def test_a_true_calibration_is_confirmed(seed: int) -> None:
    of = drive(seed)
    found = updates(SensorCalibration(of.source.rig), keyframes(of))
    assert found and not any(u.imu.any() or u.wheel.any() for u in found)
    assert np.isfinite(found[-1].imu_sigma).all() and found[0].text.startswith("confirmed: gyroscope")


def test_nothing_is_said_without_motion_or_of_another_sensor() -> None:
    of = drive(0)
    still = [
        replace(k, samples=replace(k.samples, odom_T_cam=np.tile(np.eye(4), (EVERY, 1, 1)))) for k in keyframes(of)
    ]  # type: ignore[type-var]
    assert not updates(SensorCalibration(of.source.rig), still)
    rng = np.random.default_rng(0)
    noise = [replace(k.samples.imu, gyro=rng.normal(0, 1, k.samples.imu.gyro.shape)) for k in keyframes(of)]  # type: ignore[union-attr, type-var]
    other = [
        replace(k, samples=replace(k.samples, imu=n, wheel=None)) for k, n in zip(keyframes(of), noise, strict=True)
    ]  # type: ignore[type-var]
    assert not updates(SensorCalibration(of.source.rig), other)


def test_poses_of_two_submaps_are_not_compared() -> None:
    of = drive(0)
    joined, apart = (updates(SensorCalibration(of.source.rig), keyframes(of, at)) for at in (None, 14))
    assert joined[0].kf_id == 15 and apart[0].kf_id == 29


def test_after_a_minute_without_a_keyframe_it_begins_anew() -> None:
    calibration, moved = SensorCalibration(drive(0).source.rig), np.eye(4)[None].repeat(2, axis=0)
    for n, stamps in enumerate(((1, 2), (3, 80), (81, 82))):
        samples = SensorSamples(np.array(stamps) * 10**9, moved, None, None)
        assert calibration.add(keyframe(n, stamps[1] * 10**9, np.eye(4), samples), n) is None


def test_wanted_only_when_asked_for() -> None:
    rig = drive(0).source.rig
    asked = load(None, ["tracker.calibrate_sensors=true"])
    assert SensorCalibration.from_config(Config(), rig) is None
    assert SensorCalibration.from_config(asked, rig) is not None
    assert SensorCalibration.from_config(asked, replace(rig, imu=None, wheel=None)) is None


def test_the_mapper_brings_it_without_a_map_too() -> None:
    of = drive(0)
    config = replace(Config().mapper, enabled=False)
    mapper = Mapper(config, of.source.rig, sensors=SensorCalibration(wrong(of.source.rig)))
    sent = [mapper.step(k) for k in keyframes(of)]
    brought = [(u.version, u.sensors) for u in sent if u.sensors is not None]
    assert brought and all(version == update.version for version, update in brought)
