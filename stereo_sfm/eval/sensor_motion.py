"""The motion that the cameras of a source saw, with the samples of its IMU and wheels: to calibrate and check them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from stereo_sfm.config import Config
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.types import F64, I64, ImuSamples, StereoImage, TrackState, WheelSamples

if TYPE_CHECKING:
    from stereo_sfm.calib.check import Finding
    from stereo_sfm.calib.imu_fit import ImuFit
    from stereo_sfm.calib.rig import Rig
    from stereo_sfm.calib.wheel_fit import WheelFit

GOOD = (TrackState.OK, TrackState.RECOVERED)


@dataclass
class SensorMotion:
    """The longest stretch that was tracked without a loss, by the images alone."""

    rig: Rig
    stamp_ns: list[int] = field(default_factory=list[int])
    poses: list[F64] = field(default_factory=list[F64])
    imu: list[ImuSamples] = field(default_factory=list[ImuSamples])
    wheel: list[WheelSamples] = field(default_factory=list[WheelSamples])
    _best: tuple[list[int], list[F64]] = field(default_factory=lambda: ([], []))

    def __post_init__(self) -> None:
        config = Config()
        alone = replace(config, tracker=replace(config.tracker, inertial=False, wheels=False))
        self._tracker = make_tracker(alone, self.rig)

    def watch(self, images: Iterable[StereoImage]) -> Iterator[StereoImage]:
        """Pass the images on."""
        for image in images:
            self.add(image)
            yield image

    def add(self, image: StereoImage) -> None:
        """Track the next image, and keep its samples."""
        frame, _ = self._tracker.step(image)
        if frame.state not in GOOD:
            self._keep_longest()
        else:
            self.stamp_ns.append(frame.stamp_ns)
            self.poses.append(frame.odom_T_cam)
        if image.imu is not None and len(image.imu):
            self.imu.append(image.imu)
        if image.wheel is not None and len(image.wheel):
            self.wheel.append(image.wheel)

    def _keep_longest(self) -> None:
        if len(self.stamp_ns) > len(self._best[0]):
            self._best = self.stamp_ns, self.poses
        self.stamp_ns, self.poses = [], []

    def fit_imu(self) -> ImuFit:
        """What the images say of the IMU; errors as `stereo_sfm.calib.imu_fit.fit_imu`."""
        from stereo_sfm.calib.imu import Imu
        from stereo_sfm.calib.imu_fit import fit_imu

        return fit_imu(*self._seen(), ImuSamples.joined(self.imu), self.rig.imu or Imu())

    def fit_wheel(self) -> WheelFit:
        """What the images say of the wheels; errors as `stereo_sfm.calib.wheel_fit.fit_wheel`."""
        from stereo_sfm.calib.wheel_fit import fit_wheel
        from stereo_sfm.errors import StereoSfmError

        if self.rig.wheel is None:
            raise StereoSfmError("the rig says nothing about the wheels: add `wheel:` with model and pose (--rig FILE)")
        return fit_wheel(*self._seen(), WheelSamples.joined(self.wheel), self.rig.wheel)

    def _seen(self) -> tuple[I64, F64]:
        from stereo_sfm.errors import StereoSfmError

        self._keep_longest()
        stamps, poses = self._best
        self.stamp_ns, self.poses = list(stamps), list(poses)
        if len(stamps) < 2:
            raise StereoSfmError("the images could not be tracked: IMU and wheels cannot be compared with them")
        return np.array(stamps, np.int64), np.array(poses)

    def findings(self) -> list[Finding]:
        """Judges of what the source has and the rig says; a note where the recording shows too little."""
        from stereo_sfm.calib.imu_fit import judge_imu
        from stereo_sfm.calib.wheel_fit import judge_wheel

        out: list[Finding] = []
        if self.rig.imu is not None and self.imu:
            imu = self.rig.imu
            out += _judged("gyroscope", lambda: judge_imu(self.fit_imu(), imu))
        if self.rig.wheel is not None and self.wheel:
            wheel = self.rig.wheel
            out += _judged("wheels", lambda: judge_wheel(self.fit_wheel(), wheel))
        return out


def _judged(name: str, judge: Callable[[], list[Finding]]) -> list[Finding]:
    from stereo_sfm.calib.check import Finding
    from stereo_sfm.errors import StereoSfmError

    try:
        return judge()
    except StereoSfmError as error:
        return [Finding(name, 0, str(error), judged=False)]
