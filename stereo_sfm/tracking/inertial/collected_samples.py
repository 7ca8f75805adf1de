"""What calibrates IMU and wheels: poses that the images gave, and all samples between."""

from __future__ import annotations

import numpy as np

from stereo_sfm.types import F64, ImuSamples, SensorSamples, StereoImage, WheelSamples


class CollectedSamples:
    """Since the last keyframe."""

    def __init__(self) -> None:
        self._stamp_ns: list[int] = []
        self._poses: list[F64] = []
        self._imu: list[ImuSamples] = []
        self._wheel: list[WheelSamples] = []

    def feed(self, image: StereoImage) -> None:
        """The samples up to the image that is tracked next."""
        if image.imu is not None and len(image.imu):
            self._imu.append(image.imu)
        if image.wheel is not None and len(image.wheel):
            self._wheel.append(image.wheel)

    def begin(self) -> None:
        """The odometry begins anew: poses from before do not go with those to come."""
        self._stamp_ns, self._poses = [], []

    def accept(self, stamp_ns: int, odom_T_cam: F64) -> None:
        """The images gave this pose (4, 4)."""
        self._stamp_ns.append(stamp_ns)
        self._poses.append(odom_T_cam.copy())

    def joined(self) -> SensorSamples:
        """What was collected."""
        imu = ImuSamples.joined(self._imu) if self._imu else None
        wheel = WheelSamples.joined(self._wheel) if self._wheel else None
        return SensorSamples(np.array(self._stamp_ns, np.int64), np.array(self._poses).reshape(-1, 4, 4), imu, wheel)
