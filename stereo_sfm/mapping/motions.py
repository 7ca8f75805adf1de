"""What IMU and wheels measured between two successive keyframes of a submap, as the map keeps it.

Where a keyframe between is culled, the two motions become one: preintegrated motions compose (Forster et al., 2017).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.imu import Imu
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.preintegration import Preintegrated, preintegrate
from stereo_sfm.types import F64, Keyframe, WheelLink

LONGEST_S = 10.0  # of a motion: a longer one says little


@dataclass(frozen=True, eq=False)
class Motion:
    """From the keyframe before to this one."""

    inertial: Preintegrated | None
    wheels: WheelLink | None

    @staticmethod
    def of(keyframe: Keyframe, imu: Imu | None) -> Motion | None:
        """What a keyframe brings; None if that is nothing."""
        link, inertial = keyframe.inertial, None
        if link is not None and imu is not None and len(link.gyro):
            biases: F64 = link.state[6:]
            inertial = preintegrate(
                np.diff(link.stamp_ns) * 1e-9, link.gyro, link.accel, biases[3:].copy(), biases[:3].copy(),
                imu.gyro_noise, imu.accel_noise,
            )  # fmt: skip
        return None if inertial is None and keyframe.wheels is None else Motion(inertial, keyframe.wheels)

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays."""
        parts = [vars(part).values() for part in (self.inertial, self.wheels) if part is not None]
        return sum(value.nbytes for values in parts for value in values if isinstance(value, np.ndarray))

    def then(self, following: Motion) -> Motion | None:
        """Over both; None if one of them or the whole says nothing."""
        first, second = self.inertial, following.inertial
        inertial = None if first is None or second is None else first.then(second)
        if inertial is not None and inertial.seconds > LONGEST_S:
            return None
        wheels = None
        if self.wheels is not None and following.wheels is not None:
            wheels = _wheels_then(self.wheels, following.wheels)
        return None if inertial is None and wheels is None else Motion(inertial, wheels)


def _wheels_then(first: WheelLink, second: WheelLink) -> WheelLink:
    into = se3.adjoint(se3.inverse(second.last_T_cam))
    covariance = into @ first.covariance @ into.T + second.covariance
    return WheelLink(first.last_T_cam @ second.last_T_cam, covariance)
