"""The simulated wheels against the exact path of their drive, and their way through a recording."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.drivers.options import read_options
from stereo_sfm.drivers.sim.options import SimOptions
from stereo_sfm.drivers.sim.scenes import SCENES
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.sim.wheels import RATE_HZ
from stereo_sfm.drivers.sim.world import Layout
from stereo_sfm.drivers.source import open_source
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.twist_integration import integrate_twists
from stereo_sfm.recording.record import record
from stereo_sfm.types import WheelSamples


def sim(**options: object) -> SimSource:
    scene = dataclasses.replace(SCENES["loop"], layout=Layout(gondolas=2, gondola_length=5.0, products=40))
    return SimSource("loop", scene, read_options(SimOptions, "sim", {"size": "106x100", **options}))


def sampled(source: SimSource, frames: range) -> WheelSamples:
    parts = [source.sampled(k)[1] for k in frames]
    return WheelSamples.joined([p for p in parts if p is not None])


@pytest.mark.parametrize("model", ["differential", "skid_steer", "mecanum", "twist"])
def test_integrating_exact_wheels_gives_the_path(model: str) -> None:
    source = sim(wheel=model, wheel_grade="ideal", wheel_offset_ms=7, vibration=0)
    wheel, samples = source.rig.wheel, sampled(source, range(20, 300))
    assert wheel is not None and wheel.model == model and wheel.offset_s == 0.007
    linear, angular = wheel.velocities(samples)
    begin, end = samples.stamp_ns[[0, -1]] * 1e-9 - 1.007  # the first image is at one second
    middle = 0.5 * (linear[1:] + linear[:-1]), 0.5 * (angular[1:] + angular[:-1])
    motion = integrate_twists(np.diff(samples.stamp_ns) * 1e-9, middle[1], middle[0], 0.0, 0.0)
    start, stop = source.drive.poses(np.array([begin, end])) @ wheel.left_T_wheel
    moved = se3.inverse(start) @ stop
    sideways = 2e-3 if model == "mecanum" else 0.03  # what wheels that do not roll sideways do not see of it
    assert np.linalg.norm(moved[:3, 3]) > 3 and motion.way > 6
    np.testing.assert_allclose(motion.rotation, moved[:3, :3], atol=2e-4)
    np.testing.assert_allclose(motion.position, moved[:3, 3], atol=sideways)


def test_errors_of_a_robot() -> None:
    exact = sampled(sim(wheel="differential", wheel_grade="ideal"), range(300))
    real = sampled(sim(wheel="differential", seed=3), range(300))
    np.testing.assert_allclose(np.diff(real.stamp_ns), 1e9 / RATE_HZ, atol=1)
    ways = [
        s.speeds.sum(0) for s in (sampled(sim(wheel="differential", wheel_grade="ideal", seed=3), range(300)), real)
    ]
    assert (np.abs(ways[1] / ways[0] - 1) > 1e-3).all() and (np.abs(ways[1] / ways[0] - 1) < 0.04).all()
    slipping = sampled(sim(wheel="differential", wheel_grade="ideal", wheel_slip=0.3), range(300))
    ratio = slipping.speeds[exact.speeds > 1] / exact.speeds[exact.speeds > 1]
    assert ratio.min() == 1.0 and ratio.max() == pytest.approx(1.3)


def test_wheels_roll_up_and_down_and_slip_there() -> None:
    way = {"wheel": "differential", "wheel_grade": "ideal", "vibration": 0, "seed": 1, "thresholds": 20, "ramps": 12}
    source, slipping = sim(**way), sim(**way, wheel_slip=0.3)
    wheel, samples = source.rig.wheel, sampled(source, range(20, 300))
    assert wheel is not None
    begin, end = samples.stamp_ns[[0, -1]] * 1e-9 - 1
    seconds = np.linspace(begin, end, 20_000)
    path = (source.drive.poses(seconds) @ wheel.left_T_wheel)[:, :3, 3]
    rolled = float(wheel.velocities(samples)[0][:-1, 0].sum()) / RATE_HZ
    assert np.ptp(path[:, 2]) > 0.03
    assert rolled == pytest.approx(np.linalg.norm(np.diff(path, axis=0), axis=1).sum(), rel=2e-3)
    ratio = sampled(slipping, range(300)).speeds / np.maximum(sampled(source, range(300)).speeds, 0.1)
    straight = np.abs(np.diff(sampled(source, range(300)).speeds, axis=1)[:, 0]) < 0.1
    assert 1.1 < ratio[straight].max() < 1.31 and np.median(ratio[straight]) < 1.01


def test_a_recording_keeps_them(tmp_path: Path) -> None:
    source = sim(wheel="skid_steer", frames=4, start=60, effects=False)
    expected = [source.sampled(int(k))[1] for k in source.frame_ids]
    assert len(list(record(source, tmp_path / "a.mcap"))) == 4
    with open_source(tmp_path / "a.mcap") as again:
        wheel = again.rig.wheel
        assert wheel is not None and wheel.model == "skid_steer" and len(wheel.radii_m) == 4
        for image, part in zip(again, expected, strict=True):
            assert image.wheel is not None and part is not None
            np.testing.assert_array_equal(image.wheel.speeds, part.speeds)
            np.testing.assert_array_equal(image.wheel.stamp_ns, part.stamp_ns)
