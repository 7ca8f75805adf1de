"""Motion by wheels in simulated drives: accuracy without images, honest covariance, rejected wheels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from stereo_sfm.config import Config
from stereo_sfm.drivers.options import read_options
from stereo_sfm.drivers.sim.options import SimOptions
from stereo_sfm.drivers.sim.scenes import SCENES
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.tracking.inertial.motion_sensors import MotionSensors
from stereo_sfm.types import F64, StereoImage, TrackState, WheelSamples

Change = Callable[[WheelSamples, float], WheelSamples]
DARK_S = 22.0
NOTHING = np.zeros((1, 1), np.uint8)


def unchanged(samples: WheelSamples, seconds: float) -> WheelSamples:
    return samples


@dataclass
class Drive:
    """A drive with exact poses, but for half a millimetre, until the light goes out; images are not needed."""

    options: dict[str, Any]
    change: Change = unchanged

    def __post_init__(self) -> None:
        options = read_options(SimOptions, "sim", {"size": "106x100", "rate": 15, **self.options})
        self.source = SimSource("loop", SCENES["loop"], options)
        sensors = MotionSensors.of(Config().tracker, self.source.rig)
        assert sensors is not None
        self.sensors = sensors
        self.said: list[str] = []
        self.odom = se3.inverse(self.source.pose(0)) @ self.source.drive.poses(self.source.frame_ids / 15)
        self.next, self._rng = 0, np.random.default_rng(self.source.options.seed)

    def feed(self) -> None:
        """The samples up to the next image."""
        k = self.next
        imu, wheel = self.source.sampled(k)
        wheel = None if wheel is None else self.change(wheel, k / 15)
        self.sensors.feed(StereoImage(k, self.source.stamp_ns(k), NOTHING, imu=imu, wheel=wheel))
        self.next += 1

    def until(self, seconds: float, light: bool = True) -> Drive:
        while self.next / 15 < seconds:
            k, stamp = self.next, self.source.stamp_ns(self.next)
            self.feed()
            if light:
                noise = self._rng.normal(0, 1, 6) * [5e-4, 5e-4, 5e-4, 1e-4, 1e-4, 1e-4]
                self.sensors.accept(stamp, self.odom[k] @ se3.exp(noise))
                self.said += [news for news in [self.sensors.news()] if news]
        return self

    def off_m(self) -> float:
        """Metres by which the position of the last frame is off."""
        return float(np.linalg.norm(self.error()[0][:3]))

    def error(self) -> tuple[F64, F64]:
        """(6,) error of the pose at the last frame, and its standard deviations."""
        bridge = self.sensors.bridge(self.source.stamp_ns(self.next - 1))
        assert bridge is not None
        return se3.log(se3.inverse(bridge[0]) @ self.odom[self.next - 1]), np.sqrt(np.diag(bridge[1]))


@pytest.mark.parametrize("model", ["differential", "mecanum", "twist"])
@pytest.mark.parametrize("seed", range(2))
def test_five_seconds_of_darkness_with_imu_and_wheels(model: str, seed: int) -> None:
    drive = Drive({"wheel": model, "imu": "t265", "seed": seed}).until(DARK_S)
    error, sigma = drive.until(DARK_S + 5, light=False).error()
    way = float(np.linalg.norm(drive.odom[-1][:3, 3] - drive.odom[int(DARK_S * 15)][:3, 3]))
    assert way > 3.0
    assert np.linalg.norm(error[:3]) < 0.1 and np.degrees(np.linalg.norm(error[3:])) < 0.5
    assert (np.abs(error) < 4 * sigma).all() and np.linalg.norm(sigma[:3]) < 0.2


def test_wheels_help_the_imu_and_go_without_it() -> None:
    errors = {}
    for name, options in {
        "both": {"wheel": "differential", "imu": "t265"},
        "wheels": {"wheel": "differential"},
    }.items():
        drive = Drive(options).until(DARK_S)
        error, sigma = drive.until(DARK_S + 5, light=False).error()
        errors[name] = float(np.linalg.norm(error[:3]))
        assert (np.abs(error) < 4 * sigma).all()
    imu = Drive({"imu": "t265"}).until(DARK_S).until(DARK_S + 5, light=False).error()
    assert errors["both"] < np.linalg.norm(imu[0][:3]) and errors["wheels"] < 0.15


def test_wrong_radii_are_found_against_the_images() -> None:
    drive = Drive({"wheel": "differential", "imu": "t265", "wheel_grade": "ideal"})
    wheel = drive.source.rig.wheel
    assert wheel is not None
    rig = replace(drive.source.rig, wheel=replace(wheel, radii_m=(0.0824, 0.0824)))  # 3 % too large
    drive.sensors = MotionSensors.of(Config().tracker, rig) or drive.sensors
    error, _ = drive.until(DARK_S).until(DARK_S + 5, light=False).error()
    assert np.linalg.norm(error[:3]) < 0.06  # not 3 % of five metres


def test_slip_in_turns_is_noticed_by_the_gyroscope() -> None:
    """In the dark the way in turns is in doubt; the covariance says so."""
    drive = Drive({"wheel": "differential", "imu": "t265", "wheel_slip": 0.3}).until(10.0)
    error, sigma = drive.until(15.0, light=False).error()
    assert (np.abs(error) < 4 * sigma).all() and np.linalg.norm(error[:3]) < 0.3  # of 1.2 m that the wheels add
    sure = Drive({"wheel": "differential", "imu": "t265"}).until(10.0).until(15.0, light=False).error()[1]
    assert np.linalg.norm(sigma[:3]) > 1.4 * np.linalg.norm(sure[:3])


def test_wheels_that_slipped_in_turns_do_no_harm_on_the_straight() -> None:
    """Turns with slip are in the window from which the wheels' scale is known."""
    drive = Drive({"wheel": "differential", "imu": "t265", "wheel_slip": 0.3}).until(DARK_S)
    error, sigma = drive.until(DARK_S + 5, light=False).error()
    assert np.linalg.norm(error[:3]) < 0.09 and (np.abs(error) < 4 * sigma).all()


def test_wheels_that_begin_to_slip_in_the_dark_are_noticed_by_the_accelerometer() -> None:
    """On ice, straight ahead: the gyroscope sees nothing."""

    def ice(samples: WheelSamples, seconds: float) -> WheelSamples:
        return replace(samples, speeds=1.5 * samples.speeds) if seconds > DARK_S + 1 else samples

    drive = Drive({"wheel": "differential", "imu": "t265"}, ice).until(DARK_S)
    assert drive.until(DARK_S + 5, light=False).off_m() < 0.2  # not two metres


@pytest.mark.parametrize("factor", [0.0, -1.0, 1000.0])
def test_wheels_that_are_stuck_reversed_or_in_other_units_are_left_out_and_that_is_said_once(factor: float) -> None:
    def wrong(samples: WheelSamples, seconds: float) -> WheelSamples:
        return replace(samples, speeds=samples.speeds * factor) if 8 < seconds < 16 else samples

    drive = Drive({"wheel": "differential"}, wrong).until(14.0)
    assert {text.partition(":")[0] for text in drive.said} == {"wheels_contradict_images"}
    assert len(drive.said) <= 2 and ("nothing" in drive.said[-1]) == (factor == 0.0)
    stamp = drive.source.stamp_ns(drive.next)
    assert drive.sensors.bridge(stamp) is None
    step = np.array([0.01, 0, 0.03, 0, 0, 0])
    np.testing.assert_array_equal(drive.sensors.predict(stamp, np.eye(4), step), se3.exp(step))
    assert drive.until(DARK_S).sensors.bridge(drive.source.stamp_ns(drive.next)) is not None, "they are right again"
    assert len(drive.said) <= 2


def test_a_step_is_predicted_by_the_change_of_the_wheels() -> None:
    """While the robot sets off, constant velocity is always too slow."""
    with_wheels, without = [], []
    drive = Drive({"wheel": "differential", "wheel_grade": "ideal", "vibration": 0.0}).until(1.2)
    for k in range(drive.next, drive.next + 15):
        drive.feed()
        stamp, last = drive.source.stamp_ns(k), drive.odom[k - 1]
        step = se3.log(se3.inverse(drive.odom[k - 2]) @ last)
        for found, errors in ((drive.sensors.predict(stamp, last, step), with_wheels), (last @ se3.exp(step), without)):
            errors.append(np.linalg.norm(found[:3, 3] - drive.odom[k][:3, 3]))
        drive.sensors.accept(stamp, drive.odom[k])
    assert np.mean(with_wheels) < 0.5 * np.mean(without)


def test_samples_that_are_missing_doubled_or_not_numbers_only_shorten_what_is_known() -> None:
    def untidy(samples: WheelSamples, seconds: float) -> WheelSamples:
        if 18 < seconds < 19 or not len(samples):
            return samples.part(slice(0))
        speeds = samples.speeds.copy()
        speeds[0] = np.nan if int(15 * seconds) % 5 == 0 else speeds[0]
        parts = [replace(samples, speeds=speeds), samples.part(slice(0, 1))]
        return WheelSamples.joined(parts)

    drive = Drive({"wheel": "differential", "imu": "t265"}, untidy).until(DARK_S)
    error, sigma = drive.until(DARK_S + 5, light=False).error()
    assert not drive.said and np.linalg.norm(error[:3]) < 0.1 and (np.abs(error) < 4 * sigma).all()


def test_without_sensors_there_is_nothing_and_each_can_be_disabled() -> None:
    options = read_options(SimOptions, "sim", {"size": "106x100", "wheel": "twist"})
    rig, config = SimSource("loop", SCENES["loop"], options).rig, Config().tracker
    assert MotionSensors.of(config, replace(rig, wheel=None)) is None
    assert MotionSensors.of(replace(config, wheels=False), rig) is None


@pytest.mark.parametrize("sensors", ["wheel=differential", "wheel=differential&imu=t265", ""])
def test_a_robot_is_tracked_through_the_dark(sensors: str) -> None:
    """The whole tracker, and two seconds without light at a metre a second: no new submap."""
    spec = f"sim:loop?size=212x200&rate=15&start=300&frames=90&dark=23-25&{sensors}"
    with open_source(spec) as source:
        tracker = make_tracker(Config(), source.rig)
        frames = [tracker.step(image)[0] for image in source]
        truth = source.ground_truth
    states = [f.state for f in frames]
    assert truth is not None
    if not sensors:
        assert TrackState.INERTIAL not in states and TrackState.LOST in states
        return
    assert states[45:75] == [TrackState.INERTIAL] * 30 and states[75] == TrackState.RECOVERED
    assert set(states[1:45]) | set(states[76:]) == {TrackState.OK}
    for last, limit in ((74, 0.06), (85, 0.1)):  # metres; images of a quarter of the resolution
        seen = se3.inverse(frames[44].odom_T_cam) @ frames[last].odom_T_cam
        true = se3.inverse(truth.poses[44]) @ truth.poses[last]
        assert np.linalg.norm(true[:3, 3]) > 1.0
        assert np.linalg.norm(seen[:3, 3] - true[:3, 3]) < limit
