"""What is known of the motion between two successive keyframes of a submap, as the map keeps it: by IMU and wheels,
and by odometry where the map does not know it, as they share few points.

Where a keyframe between is culled, the two motions become one: preintegrated motions compose (Forster et al., 2017).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.imu import Imu
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.preintegration import Preintegrated, preintegrate
from stereo_sfm.tracking.inertial.motion_sensors import INERTIAL_S
from stereo_sfm.types import F64, Keyframe, MotionLink


@dataclass(frozen=True, eq=False)
class Motion:
    """From the keyframe before to this one."""

    inertial: Preintegrated | None
    wheels: MotionLink | None
    odometry: MotionLink | None = None

    @staticmethod
    def of(keyframe: Keyframe, imu: Imu | None, sensors: bool = True, odometry: bool = False) -> Motion | None:
        """What a keyframe brings by IMU and wheels (`sensors`) and by images; None if that is nothing."""
        wheels = keyframe.wheels if sensors else None
        link, inertial = keyframe.inertial if sensors else None, None
        if link is not None and imu is not None and len(link.gyro):
            biases: F64 = link.state[6:]
            inertial = preintegrate(
                np.diff(link.stamp_ns) * 1e-9, link.gyro, link.accel, biases[3:].copy(), biases[:3].copy(),
                imu.gyro_noise, imu.accel_noise,
            )  # fmt: skip
        return _unless_empty(inertial, wheels, keyframe.odometry if odometry else None)

    def then(self, following: Motion) -> Motion | None:
        """Over both; None if one of them or the whole says nothing."""
        first, second = self.inertial, following.inertial
        inertial = None if first is None or second is None else first.then(second)
        if inertial is not None and inertial.seconds > INERTIAL_S:
            return None
        wheels, odometry = _joined(self.wheels, following.wheels), _joined(self.odometry, following.odometry)
        return _unless_empty(inertial, wheels, odometry)


def _unless_empty(
    inertial: Preintegrated | None, wheels: MotionLink | None, odometry: MotionLink | None
) -> Motion | None:
    nothing = inertial is None and wheels is None and odometry is None
    return None if nothing else Motion(inertial, wheels, odometry)


def _joined(first: MotionLink | None, second: MotionLink | None) -> MotionLink | None:
    """Over both; None without one of them."""
    if first is None or second is None:
        return None
    into = se3.adjoint(se3.inverse(second.last_T_cam))
    covariance = into @ first.covariance @ into.T + second.covariance
    return MotionLink(first.last_T_cam @ second.last_T_cam, covariance)
