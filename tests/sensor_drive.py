"""A simulated drive with IMU and wheels that is not rendered: poses with noise stand for the images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereo_sfm.calib.imu_fit import with_imu_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.wheel import Wheel
from stereo_sfm.drivers.options import read_options
from stereo_sfm.drivers.sim.options import SimOptions
from stereo_sfm.drivers.sim.scenes import SCENES
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, I64, ImuSamples, WheelSamples

FRAMES = 450
THREE_DEGREES = np.radians(3) * np.array([0.6, -0.64, 0.48])


def miscalibrated(rig: Rig, turn: F64, offset_s: float, radius: float) -> Rig:
    """The IMU turned by (3,) radians and with this time offset, the wheels' radii wrong by a share."""
    assert rig.imu is not None and rig.wheel is not None
    imu = with_imu_terms(rig.imu, np.append(turn, offset_s - rig.imu.offset_s))
    return replace(rig, imu=imu, wheel=replace(rig.wheel, radii_m=tuple((1 + radius) * r for r in rig.wheel.radii_m)))


class SensorDrive:
    """Half a minute of a simulated drive: exact poses with half a millimetre and half a minute of arc of noise."""

    def __init__(self, seed: int, **options: object) -> None:
        given = {"size": "106x100", "rate": 15, "seed": seed, "imu": "t265", **options}
        self.source = SimSource("loop", SCENES["loop"], read_options(SimOptions, "sim", given))
        parts = [self.source.sampled(k) for k in range(FRAMES)]
        self.imu = ImuSamples.joined([imu for imu, _ in parts if imu is not None])
        self.wheel = WheelSamples.joined([w for _, w in parts if w is not None]) if options.get("wheel") else None
        self.stamp_ns: I64 = np.array([self.source.stamp_ns(k) for k in range(FRAMES)], np.int64)
        rng = np.random.default_rng(seed)
        noise = rng.normal(0, 1, (FRAMES, 6)) * [5e-4, 5e-4, 5e-4, 1.5e-4, 1.5e-4, 1.5e-4]
        start = se3.inverse(self.source.pose(0))
        self.poses: F64 = (
            start @ self.source.drive.poses(np.arange(FRAMES) / 15) @ np.array([se3.exp(n) for n in noise])
        )

    @property
    def wheels(self) -> Wheel:
        assert self.source.rig.wheel is not None
        return self.source.rig.wheel
