"""Bad samples of IMU and wheels: one line each, and what is good goes on."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from stereo_sfm.config import Config
from stereo_sfm.drivers.checked_samples import checked_samples
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.pipeline.run import run
from stereo_sfm.types import ImuSamples, StereoImage, WheelSamples

FRAMES, PERIOD_NS = 60, 66_000_000
NOTHING = np.zeros((1, 1), np.uint8)
Change = Callable[[StereoImage], StereoImage]


@pytest.fixture(autouse=True)
def heard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logging.getLogger("stereo_sfm"), "propagate", True)


def images(change: Change = lambda image: image) -> list[StereoImage]:
    """Of a camera with an IMU at 200 Hz and wheels at 50 Hz."""
    rng, out = np.random.default_rng(0), []
    for k in range(FRAMES):
        end = (k + 1) * PERIOD_NS
        stamps = np.arange(-(-k * PERIOD_NS // 5_000_000) * 5_000_000, end, 5_000_000)
        gyro, accel = rng.normal(0, 0.2, (len(stamps), 3)), rng.normal([0, -9.8, 0], 0.3, (len(stamps), 3))
        turned = stamps[::4]
        wheel = WheelSamples.of_wheels(turned, rng.normal(10, 1, (len(turned), 2)))
        out.append(change(StereoImage(k, end, NOTHING, imu=ImuSamples(stamps, gyro, accel), wheel=wheel)))
    return out


def imu_of(image: StereoImage) -> ImuSamples:
    assert image.imu is not None
    return image.imu


def wheel_of(image: StereoImage) -> WheelSamples:
    assert image.wheel is not None
    return image.wheel


def test_good_samples_pass_unchanged(caplog: pytest.LogCaptureFixture) -> None:
    given = images()
    assert all(a is b for a, b in zip(checked_samples(given), given, strict=True))
    assert not caplog.records


def doubled(image: StereoImage) -> StereoImage:
    imu, wheel = imu_of(image), wheel_of(image)
    rows, turned = (np.repeat(np.arange(len(samples)), 2) for samples in (imu, wheel))
    return replace(image, imu=imu.part(rows), wheel=wheel.part(turned))


def disordered(image: StereoImage) -> StereoImage:
    rows = np.arange(len(imu_of(image)))
    rows[[2, 5]] = rows[[5, 2]]
    imu, wheel = imu_of(image), wheel_of(image)
    mixed = ImuSamples(imu.stamp_ns[rows], imu.gyro[rows], imu.accel[rows])
    return replace(image, imu=mixed, wheel=wheel.part(np.arange(len(wheel))[::-1].copy()))


def not_numbers(image: StereoImage) -> StereoImage:
    imu, wheel = imu_of(image), wheel_of(image)
    gyro, accel, speeds = imu.gyro.copy(), imu.accel.copy(), wheel.speeds.copy()
    gyro[1], accel[1], speeds[0] = np.nan, np.inf, np.nan
    return replace(image, imu=ImuSamples(imu.stamp_ns, gyro, accel), wheel=replace(wheel, speeds=speeds))


@pytest.mark.parametrize(
    ("change", "says"), [(doubled, "doubled"), (disordered, "out of order"), (not_numbers, "not numbers")]
)
def test_what_is_wrong_is_taken_out_and_said_once(change: Change, says: str, caplog: pytest.LogCaptureFixture) -> None:
    found = list(checked_samples(images(change)))
    assert len(caplog.records) == 2 and all(says in r.getMessage() for r in caplog.records)
    for one in (imu_of, wheel_of):
        stamps = np.concatenate([one(image).stamp_ns for image in found])
        assert (np.diff(stamps) > 0).all() and len(stamps) > FRAMES * (8 if one is imu_of else 0)
    assert np.isfinite(np.concatenate([imu_of(image).gyro for image in found])).all()
    if change is doubled:
        np.testing.assert_array_equal(imu_of(found[7]).gyro, imu_of(images()[7]).gyro)


@pytest.mark.parametrize(
    ("change", "says", "sensor"),
    [
        (lambda i: replace(i, imu=replace(i.imu, accel=i.imu.accel / 9.80665)), "is in g", "imu"),
        (lambda i: replace(i, imu=replace(i.imu, gyro=i.imu.gyro * 300)), "degrees", "imu"),
        (lambda i: replace(i, wheel=replace(i.wheel, speeds=i.wheel.speeds * 1e4)), "not in rad/s", "wheel"),
    ],
)
def test_other_units_are_left_out(change: Change, says: str, sensor: str, caplog: pytest.LogCaptureFixture) -> None:
    found = list(checked_samples(images(change)))
    (record,) = caplog.records
    assert says in record.getMessage() and "not used" in record.getMessage()
    assert getattr(found[-1], sensor) is None
    assert getattr(found[-1], "wheel" if sensor == "imu" else "imu") is not None


def test_a_sensor_that_falls_silent(caplog: pytest.LogCaptureFixture) -> None:
    def silent(image: StereoImage) -> StereoImage:
        return replace(image, imu=imu_of(image).part(slice(0)), wheel=None) if image.frame_id > 20 else image

    assert len(list(checked_samples(images(silent)))) == FRAMES
    assert sorted(r.getMessage() for r in caplog.records) == [
        f"{name} samples: no samples for more than 1 s: the run goes on without them" for name in ("inertial", "wheel")
    ]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda i: replace(i, imu=imu_of(i).shifted(-(10**15))), "another clock"),
        (lambda i: replace(i, imu=imu_of(i).part(slice(0))), "no samples for more than"),
    ],
)
def test_samples_of_another_clock_or_none_at_all(change: Change, says: str, caplog: pytest.LogCaptureFixture) -> None:
    assert len(list(checked_samples(images(change)))) == FRAMES
    (record,) = caplog.records
    assert says in record.getMessage() and "inertial" in record.getMessage()


@pytest.mark.parametrize("change", [doubled, not_numbers, disordered])
def test_a_run_goes_on(change: Change, caplog: pytest.LogCaptureFixture) -> None:
    with open_source("sim:loop?size=212x200&frames=12&rate=15&start=60&imu=t265&wheel=differential") as source:
        bad, rig, truth = [change(image) for image in source], source.rig, source.ground_truth
    frames = list(run(MemorySource(rig, bad, truth), Config()))
    assert len(frames) == 12 and {f.state.name for f in frames} == {"OK"}
    assert len(caplog.records) == 2
