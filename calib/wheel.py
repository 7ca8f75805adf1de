"""`Wheel`: geometry, pose and noise of the wheel odometry of a rig."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from stereo_sfm.calib.imu import MAX_OFFSET_S
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import F64, ReadOnly, WheelSamples

WHEELS = {"twist": (0,), "differential": (2,), "skid_steer": (2, 4), "mecanum": (4,)}  # number of wheels by model


@dataclass(frozen=True, eq=False)
class Wheel(ReadOnly):
    """Wheel odometry of a robot on the floor, in wheel axes: x forward, y left, z up, origin amid the driven wheels.

    With model "twist" the samples are velocities, corrected by `linear_matrix` and `angular_scale`. With the others
    they are the wheels' own speeds: left, right (differential, skid_steer), or front left, front right, rear left, rear
    right (skid_steer, mecanum).
    """

    left_T_wheel: F64 = field(default_factory=lambda: np.eye(4))  # (4, 4)
    model: str = "twist"
    radii_m: tuple[float, ...] = ()  # of each wheel
    track_m: float = 0.0  # between left and right wheels; for skid_steer the effective one
    wheelbase_m: float = 0.0  # between front and rear wheels, mecanum only
    linear_matrix: F64 = field(default_factory=lambda: np.eye(3))  # (3, 3) scale and alignment of velocities
    angular_scale: float = 1.0
    slip: float = 0.05  # standard deviation of a speed's lasting error, as a share of it
    speed_noise: float = 0.01  # m/s/sqrt(Hz), white
    tick_m: float = 0.001  # path per count of the encoders
    rate_hz: float = 50.0
    offset_s: float = 0.0  # wheel stamp minus camera stamp of the same instant

    def __post_init__(self) -> None:
        if self.model not in WHEELS:
            raise StereoSfmError(f"invalid calibration: wheels of model '{self.model}' (known: {', '.join(WHEELS)})")
        if len(self.radii_m) not in WHEELS[self.model]:
            wanted = " or ".join(str(n) for n in WHEELS[self.model])
            raise StereoSfmError(
                f"invalid calibration: {self.model} wheels have {wanted} radii, not {len(self.radii_m)}"
            )
        rotation = self.left_T_wheel[:3, :3]
        if self.left_T_wheel.shape != (4, 4) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
            raise StereoSfmError("invalid calibration: the pose of the wheels is not rigid; check left_T_wheel")
        for array in (self.left_T_wheel, self.linear_matrix):
            array.flags.writeable = False
        positive = (*self.radii_m, self.slip, self.speed_noise, self.tick_m, self.rate_hz)
        positive += (self.track_m,) if self.radii_m else ()
        positive += (self.wheelbase_m,) if self.model == "mecanum" else ()
        finite = all(np.isfinite(a).all() for a in (self.left_T_wheel, self.linear_matrix, self.angular_scale))
        if not finite or not all(np.isfinite(p) and p > 0 for p in positive):
            raise StereoSfmError(
                "invalid calibration of the wheels: a number is not finite, or a radius, track or noise is not positive"
            )
        if not abs(self.offset_s) <= MAX_OFFSET_S:
            raise StereoSfmError(f"invalid calibration: time offset of {self.offset_s:g} s between camera and wheels")

    def seen_from(self, new_T_left: F64) -> Wheel:
        """The same wheels relative to another left camera frame, (4, 4)."""
        return replace(self, left_T_wheel=new_T_left @ self.left_T_wheel)

    @property
    def _width(self) -> float:
        """Metres by which a rotation of one radian moves the right rims more than the left ones."""
        return self.track_m + (self.wheelbase_m if self.model == "mecanum" else 0.0)

    def velocities(self, samples: WheelSamples) -> tuple[F64, F64]:
        """Linear (N, 3) m/s and angular (N, 3) rad/s velocity in wheel axes; NaN if the samples have other wheels."""
        count = len(samples)
        if self.model == "twist":
            return samples.linear @ self.linear_matrix.T, samples.angular * self.angular_scale
        linear, angular = np.zeros((count, 3)), np.zeros((count, 3))
        if samples.speeds.shape[1] != len(self.radii_m):
            return linear + np.nan, angular + np.nan
        ahead = samples.speeds * np.array(self.radii_m)  # (N, W) m/s of each wheel's rim
        left, right = ahead[:, ::2].mean(axis=1), ahead[:, 1::2].mean(axis=1)
        linear[:, 0] = 0.5 * (left + right)
        angular[:, 2] = (right - left) / self._width
        if self.model == "mecanum":
            linear[:, 1] = 0.25 * (ahead[:, 1] + ahead[:, 2] - ahead[:, 0] - ahead[:, 3])
        return linear, angular

    def speeds(self, linear: F64, angular: F64) -> F64:
        """(N, W) rad/s of each wheel that make velocities (N, 3): the inverse of `velocities`."""
        turn = 0.5 * self._width * angular[:, 2]
        side = linear[:, 1] if self.model == "mecanum" else 0.0 * linear[:, 1]
        ahead = linear[:, 0]
        rims = [ahead - side - turn, ahead + side + turn, ahead + side - turn, ahead - side + turn]
        return np.stack(rims[: len(self.radii_m)], axis=1) / np.array(self.radii_m)
