"""Terms by which the calibration of IMU and wheels is corrected."""

from __future__ import annotations

from dataclasses import replace

from stereo_sfm.calib.imu_fit import with_imu_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.wheel_fit import with_wheel_terms
from stereo_sfm.types import SensorUpdate


def with_sensor_terms(rig: Rig, update: SensorUpdate) -> Rig:
    """The rig with the terms of an update added to the calibration of its sensors."""
    imu = None if rig.imu is None else with_imu_terms(rig.imu, update.imu)
    wheel = None if rig.wheel is None else with_wheel_terms(rig.wheel, update.wheel)
    return replace(rig, imu=imu, wheel=wheel)
