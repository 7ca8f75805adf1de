"""Calibration of IMU and wheels against the motion of a camera: recovery of wrong values, wrong sensors, commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib import load_rig, save_rig
from stereo_sfm.calib.imu_fit import fit_imu, judge_imu, mean_force, precision_imu, with_imu_terms
from stereo_sfm.calib.robust_fit import Whitening, robust_fit, shift_between
from stereo_sfm.calib.sample_noise import judge_noise, judge_wheel_noise, noise_at_rest, noise_of_speeds
from stereo_sfm.calib.wheel_fit import fit_wheel, judge_wheel, precision_wheel
from stereo_sfm.cli import main
from stereo_sfm.drivers.sim.inertial import GRADES
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import ImuSamples
from tests.sensor_drive import FRAMES, THREE_DEGREES, SensorDrive, miscalibrated


@pytest.mark.parametrize("seed", range(3))
def test_20_ms_and_3_degrees_of_an_imu_are_found(seed: int) -> None:
    found = SensorDrive(seed, imu_offset_ms=20)
    true = found.source.rig.imu
    assert true is not None
    wrong = with_imu_terms(true, np.append(THREE_DEGREES, -true.offset_s))
    fit = fit_imu(found.stamp_ns, found.poses, found.imu, wrong)
    off = np.degrees(np.linalg.norm(se3.so3_log(fit.imu.left_T_imu[:3, :3].T @ true.left_T_imu[:3, :3])))
    assert abs(fit.imu.offset_s - 0.02) < 5e-4 and off < 0.1
    assert abs(fit.imu.offset_s - 0.02) < 4 * fit.offset_sigma_s and fit.offset_sigma_s < 5e-4
    assert abs(np.degrees(fit.turned) - 3) < 0.1
    assert {f.name: f.level > 0 for f in judge_imu(fit, wrong)} == {
        "gyroscope": False, "IMU rotation": True, "IMU time offset": True, "accelerometer": False, "IMU noise": False
    }  # fmt: skip
    again = judge_imu(fit_imu(found.stamp_ns, found.poses, found.imu, fit.imu), fit.imu)
    assert not any(f.level for f in again)
    assert max(f.level for f in precision_imu(fit)) <= 1


@pytest.mark.parametrize("imu", ["t265", "oak", "bno086"])
def test_noise_shows_while_the_camera_stands(imu: str) -> None:
    found = SensorDrive(0, imu=imu, rest=12, vibration=0)
    known, grade = found.source.rig.imu, GRADES[imu]
    assert known is not None
    noise = noise_at_rest(found.stamp_ns, found.poses, found.imu)
    np.testing.assert_allclose(noise, [grade.gyro_noise, grade.accel_noise], rtol=0.15)
    optimistic = replace(known, accel_noise=known.accel_noise / 5)
    levels = [judge_noise(noise, k).level for k in (known, optimistic, replace(known, gyro_noise=1e-6))]
    assert levels == [0, 1, 2]
    fit = fit_imu(found.stamp_ns, found.poses, found.imu, optimistic)
    assert {f.name for f in judge_imu(fit, optimistic) if f.level} == {"IMU noise"}
    moving = SensorDrive(0, imu=imu)
    said = judge_noise(noise_at_rest(moving.stamp_ns, moving.poses, moving.imu), known)
    assert not said.judged and "does not stand" in said.text


def test_accelerations_show_a_rotation_about_the_only_axis_of_turns() -> None:
    found = SensorDrive(0, vibration=0.0)
    true = found.source.rig.imu
    assert true is not None
    up = true.left_T_imu[:3, :3].T @ found.source.drive.robot_T_cam[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    wrong = replace(
        true, left_T_imu=true.left_T_imu @ se3.from_rotation_translation(se3.so3_exp(0.05 * up), np.zeros(3))
    )

    def off_deg(samples: ImuSamples) -> tuple[float, float]:
        fit = fit_imu(found.stamp_ns, found.poses, samples, wrong)
        off = se3.so3_log(fit.imu.left_T_imu[:3, :3].T @ true.left_T_imu[:3, :3])
        return float(np.degrees(np.linalg.norm(off))), float(np.degrees(fit.rotation_sigma.max()))

    both, sigma = off_deg(found.imu)
    alone = ImuSamples(found.imu.stamp_ns, found.imu.gyro, np.full_like(found.imu.accel, np.nan))
    assert both < 0.3 and sigma < 0.3
    assert off_deg(alone)[1] > 3 * sigma


@pytest.mark.parametrize(
    ("change", "name", "says"),
    [
        (lambda s: ImuSamples(s.stamp_ns, np.degrees(s.gyro), s.accel), "gyroscope", "degrees"),
        (lambda s: ImuSamples(s.stamp_ns, s.gyro, s.accel / 9.80665), "accelerometer", "in g"),
        (lambda s: ImuSamples(s.stamp_ns, s.gyro[:, [2, 0, 1]].copy(), s.accel), "IMU rotation", "exchanged"),
        (lambda s: ImuSamples(s.stamp_ns, s.gyro[::-1].copy(), s.accel), "gyroscope", "not those of the images"),
    ],
)
def test_wrong_units_axes_and_sensors_fail(change: Callable[[ImuSamples], ImuSamples], name: str, says: str) -> None:
    found = SensorDrive(0)
    known = found.source.rig.imu
    assert known is not None
    fit = fit_imu(found.stamp_ns, found.poses, change(found.imu), known)
    failed = {f.name: f.text for f in judge_imu(fit, known) if f.level == 2}
    assert says in failed[name]


def test_a_mean_force_of_tilts_and_of_vibration() -> None:
    """Half a minute of tilts by up to 50 degrees, at 0.3 Hz, and of 20 m/s^2 at 37 Hz."""
    times = np.arange(0, 30, 0.005)
    tilt = np.radians(50) * np.sin(2 * np.pi * 0.3 * times)
    force = 9.81 * np.stack([np.sin(tilt), np.cos(tilt), np.zeros(len(times))], axis=1)
    assert np.linalg.norm(force.mean(axis=0)) < 9.0
    shaken = force + 20 * np.sin(2 * np.pi * 37 * times)[:, None]
    for samples in (force, shaken, shaken[:-17]):
        assert mean_force(times[: len(samples)], samples) == pytest.approx(9.81, abs=0.3)
    assert np.isnan(mean_force(times[:0], force[:0]))


def test_samples_with_gaps_doubles_and_nan_are_used_as_far_as_they_go() -> None:
    found = SensorDrive(1)
    known, rng = found.source.rig.imu, np.random.default_rng(0)
    assert known is not None
    rows = np.sort(np.concatenate([rng.permutation(len(found.imu))[: len(found.imu) * 9 // 10], np.arange(40)]))
    gyro = found.imu.gyro[rows]
    gyro[::50] = np.nan
    untidy = ImuSamples(found.imu.stamp_ns[rows], gyro, found.imu.accel[rows])
    fit = fit_imu(found.stamp_ns, found.poses, untidy, known)
    assert not any(f.level for f in judge_imu(fit, known))


def test_a_recording_that_shows_nothing_is_refused() -> None:
    found = SensorDrive(0)
    known = found.source.rig.imu
    assert known is not None
    with pytest.raises(StereoSfmError, match="hardly turns"):
        fit_imu(found.stamp_ns, np.tile(np.eye(4), (FRAMES, 1, 1)), found.imu, known)
    with pytest.raises(StereoSfmError, match="images lie within IMU samples"):
        fit_imu(found.stamp_ns + 10**12, found.poses, found.imu, known)
    wheel = SensorDrive(0, wheel="twist")
    assert wheel.wheel is not None
    with pytest.raises(StereoSfmError, match=r"0\.00 m of motion"):
        fit_wheel(wheel.stamp_ns, np.tile(np.eye(4), (FRAMES, 1, 1)), wheel.wheel, wheel.wheels)


@pytest.mark.parametrize("model", ["differential", "mecanum", "twist"])
@pytest.mark.parametrize("seed", range(2))
def test_2_percent_of_the_radii_are_found(model: str, seed: int) -> None:
    found = SensorDrive(seed, wheel=model, wheel_grade="ideal", wheel_offset_ms=30)
    true = found.wheels
    wrong = replace(true, radii_m=tuple(1.02 * r for r in true.radii_m), offset_s=0.0)
    wrong = replace(true, linear_matrix=1.02 * np.eye(3), offset_s=0.0) if model == "twist" else wrong
    assert found.wheel is not None
    fit = fit_wheel(found.stamp_ns, found.poses, found.wheel, wrong)
    assert abs((1 + fit.value[0]) * 1.02 - 1) < 2e-3 and fit.sigma[0] < 4e-3
    assert abs(fit.wheel.offset_s - 0.03) < 0.02 and fit.agreement > 0.95
    assert abs(fit.wheel.track_m / true.track_m - 1) < 0.03
    assert "wheels' scale" in {f.name for f in judge_wheel(fit, wrong) if f.level}
    again = judge_wheel(fit_wheel(found.stamp_ns, found.poses, found.wheel, fit.wheel), fit.wheel)
    assert not any(f.level for f in again)
    assert max(f.level for f in precision_wheel(fit)) <= 1


def test_noise_of_wheels() -> None:
    found = SensorDrive(0, wheel="differential")  # ticks of 1 mm, 5 mm/s of a sample
    assert found.wheel is not None
    known = replace(found.wheels, speed_noise=0.001)
    fit = fit_wheel(found.stamp_ns, found.poses, found.wheel, known)
    assert 0.5 < fit.noise / np.hypot(5e-3 / np.sqrt(2 * 50), 1e-3 * np.sqrt(5 / 36 * 50)) < 1.5
    assert judge_wheel_noise(fit.noise, known).level == 0
    rng = np.random.default_rng(0)
    noisy = replace(found.wheel, speeds=found.wheel.speeds + rng.normal(0, 4.0, found.wheel.speeds.shape))
    worse = fit_wheel(found.stamp_ns, found.poses, noisy, known)
    assert [f.level for f in judge_wheel(worse, known) if f.name == "wheels' noise"] == [1]
    assert not judge_wheel_noise(noise_of_speeds(found.wheel.stamp_ns, np.zeros(len(found.wheel))), known).judged


@pytest.mark.parametrize("seed", range(2))
def test_where_the_wheels_are_shows_in_turns(seed: int) -> None:
    found = SensorDrive(seed, wheel="differential", spot_turns=True)
    moved = se3.from_rotation_translation(np.eye(3), np.array([-0.2, 0.1, 0.0]))
    wrong = replace(found.wheels, left_T_wheel=found.wheels.left_T_wheel @ moved)
    assert found.wheel is not None
    fit = fit_wheel(found.stamp_ns, found.poses, found.wheel, wrong)
    np.testing.assert_allclose(fit.value[6:], [0.2, -0.1], atol=0.02)
    np.testing.assert_allclose(fit.wheel.left_T_wheel[:3, 3], found.wheels.left_T_wheel[:3, 3], atol=0.02)
    assert {f.name for f in judge_wheel(fit, wrong) if "position" in f.name and f.level == 1} == {
        "wheels' position ahead", "wheels' position to the left"
    }  # fmt: skip
    before_the_turn = slice(0, 150)
    straight = fit_wheel(found.stamp_ns[before_the_turn], found.poses[before_the_turn], found.wheel, wrong)
    assert not np.isfinite(straight.sigma[6:]).any() and not straight.value[6:].any()


def test_wheels_that_count_backwards_or_are_exchanged() -> None:
    found = SensorDrive(0, wheel="differential")
    assert found.wheel is not None
    for speeds, says in ((-found.wheel.speeds, "backwards"), (found.wheel.speeds[:, ::-1].copy(), "exchange left")):
        fit = fit_wheel(found.stamp_ns, found.poses, replace(found.wheel, speeds=speeds), found.wheels)
        (finding,) = judge_wheel(fit, found.wheels)
        assert finding.level == 2 and says in finding.text
    other = replace(found.wheels, model="mecanum", radii_m=(0.1,) * 4, wheelbase_m=0.3)
    with pytest.raises(StereoSfmError, match="not those of mecanum wheels"):
        fit_wheel(found.stamp_ns, found.poses, found.wheel, other)


def test_a_fit_ignores_outliers_and_knows_its_error() -> None:
    rng = np.random.default_rng(0)
    t = np.linspace(0, 1, 400)
    errors, said = [], []
    for _ in range(20):
        y = 2.0 + 3.0 * t + rng.normal(0, 0.1, 400)
        y[rng.random(400) < 0.1] += 5.0
        fit = robust_fit(lambda x, y=y: (y - x[0] - x[1] * t)[:, None], np.zeros(2), np.ones(2))
        errors.append(fit.value - [2, 3])
        said.append(fit.sigma)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (rms < [0.06, 0.1]).all()
    np.testing.assert_allclose(np.mean(said, axis=0), rms, rtol=0.8)


@pytest.mark.parametrize("start", [0.0, 1e-16, -0.3])
def test_a_fit_leaves_a_start_that_is_nearly_zero(start: float) -> None:
    t = np.linspace(0, 1, 400)
    fit = robust_fit(lambda x: (0.02 * np.sin(9 * t) - x[0] - x[1] * t)[:, None], np.array([0.0, start]), np.ones(2))
    expected = np.polyfit(t, 0.02 * np.sin(9 * t), 1)[::-1]
    np.testing.assert_allclose(fit.value, expected, atol=1e-3)


def test_a_shift() -> None:
    t = np.linspace(0, 20, 500)
    signal = lambda s: np.sin(2 * s) + np.cos(3.3 * s)  # noqa: E731
    assert shift_between(signal, signal(t + 0.125), t, 0.3) == pytest.approx(0.125)


def test_the_command_needs_something_to_calibrate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "sim:loop", "-o", str(tmp_path / "a.yaml")]) == 2
    assert "needs --target for the cameras, or --imu or --wheel" in capsys.readouterr().err
    spec = "sim:loop?size=106x100&frames=2"
    assert main(["calibrate", spec, "--imu", "-o", str(tmp_path / "a.yaml")]) == 2
    assert "has no inertial samples" in capsys.readouterr().err


@pytest.mark.slow
def test_wrong_sensors_of_a_recording_are_calibrated_and_checked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = "sim:loop?size=424x400&rate=15&frames=450&imu=t265&imu_offset_ms=20&wheel=differential&wheel_grade=ideal"
    with open_source(spec) as source:
        rig = source.rig
    assert rig.imu is not None and rig.wheel is not None
    save_rig(miscalibrated(rig, THREE_DEGREES, 0.0, 0.02), tmp_path / "wrong.yaml")
    options = ["--rig", str(tmp_path / "wrong.yaml")]
    assert main(["calibrate", spec, "--imu", "--wheel", *options, "-o", str(tmp_path / "right.yaml")]) == 0
    print(capsys.readouterr().out)
    found = load_rig(tmp_path / "right.yaml")
    assert found.imu is not None and found.wheel is not None
    off = np.degrees(np.linalg.norm(se3.so3_log(found.imu.left_T_imu[:3, :3].T @ rig.imu.left_T_imu[:3, :3])))
    ratio = np.mean(found.wheel.radii_m) / 0.08  # as good as the lengths by the images, at half the resolution
    print(f"offset {1e3 * (found.imu.offset_s - 0.02):.3f} ms, rotation {off:.3f} deg, radii {100 * (ratio - 1):.3f} %")
    assert abs(found.imu.offset_s - 0.02) < 5e-4 and off < 0.1 and abs(ratio - 1) < 6e-3


def test_whitened_errors_are_independent() -> None:
    poses = np.random.default_rng(0).normal(0, 0.5, (20001, 1))
    new = Whitening(np.array([0.5, -0.25]))(np.diff(poses, axis=0))
    assert abs(new.std() - 1) < 0.03 and abs(np.corrcoef(new[1:, 0], new[:-1, 0])[0, 1]) < 0.03
