"""What IMU and wheels say of the motion: the next pose, and poses while the images give none."""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.inertial.inertial_motion import InertialMotion
from stereo_sfm.tracking.inertial.rest import Rest
from stereo_sfm.tracking.inertial.wheel_motion import WheelMotion
from stereo_sfm.types import F64, StereoImage

SHORT_S = 0.2  # over which the IMU alone is as good as with the wheels
INERTIAL_S, WHEEL_S = 10.0, 30.0  # longest time without images, by the IMU alone and with wheels
BRIDGED_M = 0.5  # largest standard deviation of a position without images


class MotionSensors:
    """The IMU, the wheels, or both."""

    def __init__(self, inertial: InertialMotion | None, wheels: WheelMotion | None) -> None:
        self._inertial, self._wheels = inertial, wheels
        self._rest = Rest()
        self._last_ns = 0
        self._said: set[str] = set()

    @staticmethod
    def of(config: TrackerConfig, rig: Rig) -> MotionSensors | None:
        """Those of a rig that are to be used; None if there are none."""
        inertial = InertialMotion(rig.imu) if rig.imu is not None and config.inertial else None
        wheels = WheelMotion(rig.wheel) if rig.wheel is not None and config.wheels else None
        return None if inertial is None and wheels is None else MotionSensors(inertial, wheels)

    def feed(self, image: StereoImage) -> None:
        """The samples up to the image that is tracked next."""
        if self._inertial is not None:
            self._inertial.feed(image.imu)
        if self._wheels is not None:
            self._wheels.feed(image.wheel)

    def begin(self, stamp_ns: int, odom_T_cam: F64) -> None:
        """The odometry begins anew here: poses from before do not go with those to come."""
        self._last_ns = stamp_ns
        self._rest.forget()
        for sensor in (self._inertial, self._wheels):
            if sensor is not None:
                sensor.begin(stamp_ns, odom_T_cam)

    def accept(self, stamp_ns: int, odom_T_cam: F64) -> None:
        """The images gave this pose (4, 4)."""
        self._last_ns = stamp_ns
        for sensor in (self._inertial, self._wheels):
            if sensor is not None:
                sensor.accept(stamp_ns, odom_T_cam)

    def settled(self, stamp_ns: int, odom_T_cam: F64) -> F64:
        """The pose (4, 4) that the images gave, or the one that is held while the robot stands."""
        answers = [s.still(stamp_ns) for s in (self._inertial, self._wheels) if s is not None]
        still = True in answers and False not in answers
        return self._rest.settled(stamp_ns, odom_T_cam, still)

    def predict(self, stamp_ns: int, odom_T_last: F64, step: F64) -> F64:
        """(4, 4) odom_T_cam at a time after the last pose (4, 4); `step` (6,) where the sensors do not reach."""
        inertial, wheels = self._inertial, self._wheels
        if wheels is not None and (stamp_ns - self._last_ns) * 1e-9 > SHORT_S:
            bridge = self._bridge(stamp_ns)
            if bridge is not None:
                return bridge[0]
        if wheels is not None:
            step = wheels.changed(stamp_ns, step)
        expected = odom_T_last @ se3.exp(step)
        return expected if inertial is None else inertial.predict(stamp_ns, expected)

    def bridge(self, stamp_ns: int) -> tuple[F64, F64] | None:
        """Pose (4, 4) and covariance (6, 6) since the last pose from images; None if they are not accurate enough."""
        bridge = self._bridge(stamp_ns)
        exact = bridge is not None and float(np.sqrt(np.trace(bridge[1][:3, :3]) / 3)) < BRIDGED_M
        return bridge if exact else None

    def _bridge(self, stamp_ns: int) -> tuple[F64, F64] | None:
        seconds = (stamp_ns - self._last_ns) * 1e-9
        short = self._inertial is not None and seconds <= INERTIAL_S
        by_imu = self._inertial.bridge(stamp_ns) if self._inertial is not None and short else None
        by_wheels = None
        if self._wheels is not None and seconds <= WHEEL_S:
            gyro = None if self._inertial is None else self._inertial.turning(stamp_ns)
            by_wheels = self._wheels.predict(stamp_ns, gyro)
        if by_imu is None or by_wheels is None:
            return by_imu or by_wheels
        return fused(by_imu, by_wheels)

    def level(self, odom_T_cam: F64) -> tuple[float, float] | None:
        """Roll and pitch in degrees of the camera (4, 4) against measured gravity; None while that is not known."""
        return None if self._inertial is None else self._inertial.level(odom_T_cam)

    def gravity(self, odom_T_cam: F64) -> tuple[F64, float] | None:
        """Its direction in the camera (4, 4), (3,), and how accurate that is, radians; None while it is not known."""
        return None if self._inertial is None else self._inertial.gravity(odom_T_cam)

    def news(self) -> str:
        """Why a sensor is left out, once; "" otherwise."""
        reasons = ["" if self._inertial is None else self._inertial.left_out]
        reasons += ["wheels_contradict_images"] if self._wheels is not None and self._wheels.left_out else []
        new = [r for r in reasons if r and r not in self._said]
        self._said.update(new)
        return new[0] if new else ""


def fused(by_imu: tuple[F64, F64], by_wheels: tuple[F64, F64]) -> tuple[F64, F64]:
    """The rotation of the IMU, and the position by both, each with the weight of its covariance."""
    (pose, covariance), (other, _) = by_imu, by_wheels
    turned = [p[:3, :3] @ c[:3, :3] @ p[:3, :3].T for p, c in (by_imu, by_wheels)]
    gain = turned[0] @ np.linalg.inv(turned[0] + turned[1])
    position = pose[:3, 3] + gain @ (other[:3, 3] - pose[:3, 3])
    left = pose[:3, :3].T @ (turned[0] - gain @ turned[0]) @ pose[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3], out[3:, 3:] = 0.5 * (left + left.T), covariance[3:, 3:]
    return se3.from_rotation_translation(pose[:3, :3], position), out
