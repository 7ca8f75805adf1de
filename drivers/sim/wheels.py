"""The simulated wheel odometry: exact wheel speeds along a drive, with wrong radii, slip, noise and ticks.

The axle is below the camera, where the drive's curve is; the heading of a drive is its tangent smoothed over a quarter
of a second, so that a robot with two wheels drifts sideways by millimetres in turns, as real ones do. Wheels slip in
turns and where they climb thresholds and ramps; somebody who pushes the robot sideways drags them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.wheel import Wheel
from stereo_sfm.drivers.sim.drives import Drive
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, I64, WheelSamples

RATE_HZ = 50.0
PHASE = 0.6  # of a period
TURNING = 0.15, 0.4  # rad/s between which the slip of turns sets in
RADIUS_M, TRACK_M, WHEELBASE_M = 0.08, 0.42, 0.36


@dataclass(frozen=True)
class WheelGrade:
    """Errors of a robot's wheels that its calibration does not contain."""

    radius: float = 0.0  # standard deviation, as a share, of all wheels together
    difference: float = 0.0  # the same, of each wheel
    track: float = 0.0  # standard deviation, as a share
    noise: float = 0.0  # m/s of a sample, standard deviation
    tick_m: float = 0.0  # path per count of the encoders
    threshold: float = 0.0  # m/s below which a wheel counts nothing


GRADES = {"ideal": WheelGrade(), "robot": WheelGrade(0.01, 0.001, 0.02, 0.005, 0.001, 0.01)}
_WHEELS = {"differential": 2, "skid_steer": 4, "mecanum": 4, "twist": 2}


class WheelSensor:
    """Wheel speeds, or with model "twist" the velocities that a robot's controller makes of them."""

    def __init__(
        self, model: str, grade: str, slip: float, drive: Drive, rng: np.random.Generator, offset_s: float = 0.0
    ) -> None:
        """Args:
        model: of `Wheel`. grade: of GRADES. slip: share by which wheels turn too far in turns and on thresholds.
        offset_s: its clock minus the camera's.
        """
        self._drive, self._twist, count = drive, model == "twist", _WHEELS[model]
        below = se3.from_rotation_translation(np.eye(3), np.array([0.0, 0.0, -drive.gait.height]))
        self._driven = Wheel(
            se3.inverse(drive.robot_T_cam) @ below, "differential" if self._twist else model, (RADIUS_M,) * count,
            TRACK_M, WHEELBASE_M, rate_hz=RATE_HZ, offset_s=offset_s,
        )  # fmt: skip
        self.wheel = replace(self._driven, model=model, radii_m=()) if self._twist else self._driven
        self._speeds = self._measured(GRADES[grade], slip, rng)

    def _measured(self, grade: WheelGrade, slip: float, rng: np.random.Generator) -> F64:
        """(N, W) rad/s of every sample of the drive, as the encoders count them."""
        count = len(self._driven.radii_m)
        radii = RADIUS_M * (1 + rng.normal(0, grade.radius) + rng.normal(0, grade.difference, count))
        track = TRACK_M * (1 + rng.normal(0, grade.track))
        true = replace(self._driven, radii_m=tuple(radii.tolist()), track_m=track)
        seconds: F64 = (np.arange(int((self._drive.duration + 1) * RATE_HZ) + 1, dtype=np.float64) + PHASE) / RATE_HZ
        linear, angular = self.exact(seconds)
        slow, fast = TURNING
        slipping = np.clip((np.abs(angular[:, 2:]) - slow) / (fast - slow), 0, 1)
        if self._drive.floor is not None:
            slipping = np.maximum(slipping, self._drive.floor.slipping(self._drive.metres(seconds))[:, None])
        rims = true.speeds(linear, angular) * (1 + slip * slipping) * RADIUS_M
        rims += rng.normal(0, grade.noise, rims.shape) * (np.abs(rims) > grade.threshold)
        rims[np.abs(rims) < grade.threshold] = 0.0
        if grade.tick_m:
            ticks = np.round(np.cumsum(rims, axis=0) / RATE_HZ / grade.tick_m)
            rims = np.diff(ticks, axis=0, prepend=0.0) * grade.tick_m * RATE_HZ
        return rims / RADIUS_M

    def exact(self, seconds: F64) -> tuple[F64, F64]:
        """Linear and angular velocity (N, 3) of the robot in its own axes at times (N,), without vibration."""
        speed, heading = self._drive.course(seconds, 1), self._drive.course(seconds)[:, 2]
        ahead, left = np.cos(heading), np.sin(heading)
        linear, angular = np.zeros((len(seconds), 3)), np.zeros((len(seconds), 3))
        linear[:, 0] = speed[:, 0] * ahead + speed[:, 1] * left
        linear[:, 1] = speed[:, 1] * ahead - speed[:, 0] * left
        angular[:, 2] = speed[:, 2]
        if (floor := self._drive.floor) is not None:  # along the slope, turning about an axis that leans with the robot
            metres = self._drive.metres(seconds)
            rise, tilt = floor.climb(metres) * self._drive.metres(seconds, 1), floor.tilt(metres)
            linear[:, 0] = linear[:, 0] * np.cos(tilt) + rise * np.sin(tilt)
            angular[:, 2] *= np.cos(tilt)
        return linear, angular

    def samples(self, begin: float, end: float, epoch_ns: int) -> WheelSamples:
        """Samples after `begin` until `end` (seconds of the drive, camera's clock)."""
        rows = np.arange(*(max(0, int(np.floor(t * RATE_HZ - PHASE + 1e-9)) + 1) for t in (begin, end)))
        seconds: F64 = np.asarray((rows + PHASE) / RATE_HZ, np.float64)
        stamp_ns: I64 = epoch_ns + np.round((seconds + self.wheel.offset_s) * 1e9).astype(np.int64)
        counted = WheelSamples.of_wheels(stamp_ns, self._speeds[rows])
        return WheelSamples(stamp_ns, *self._driven.velocities(counted)) if self._twist else counted
