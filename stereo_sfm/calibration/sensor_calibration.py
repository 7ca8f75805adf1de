"""Calibration of IMU and wheels while driving: time offset and rotation; radii, track and pose.

Keyframes bring the poses that the images alone gave, and the samples (`Keyframe.samples`). Every few seconds those of
the last minute are compared as `calibrate --imu` and `calibrate --wheel` do. A term is corrected once it is known well
and differs from the one in use by several standard deviations, and by more than what the comparison leaves.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.check import Finding
from stereo_sfm.calib.imu_fit import fit_imu, imu_terms, judge_imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.wheel_fit import fit_wheel, judge_wheel
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import F64, I64, ImuSamples, Keyframe, SensorSamples, SensorUpdate, WheelSamples

WINDOW_S = 60.0  # seconds compared, the last
FIRST_S, EVERY_S = 15.0, 10.0  # seconds until the first comparison, and from one to the next
SIGMAS = 5.0  # standard deviations of a first correction: the samples compared are not independent
BETTER = 0.7  # times the standard deviation of a corrected term, half its variance: it is replaced
# Standard deviations from which a term is known, and differences that are left: what images of half the size leave of a
# true calibration (0.2 degrees about the vertical axis, which only small accelerations show, 0.5 ms), with room.
IMU_KNOWN = np.append(np.full(3, np.radians(0.3)), 1e-3)
# Of `wheel_fit.NAMES`; their time offset stays: how a robot slides in turns looks like one of 15 ms.
WHEEL_KNOWN = np.array([3e-3, 3e-3, 1e-2, np.radians(0.3), np.radians(0.3), 0.0, 0.03, 0.03])
WHEEL_LEFT = np.array([5e-3, 5e-3, 3e-2, np.radians(1.0), np.radians(1.0), 0.0, 0.05, 0.05])
AGREEMENT = 0.7  # correlation of both with the images, half of the variance: less is another sensor's data, or slip
WRONG_SCALE = 0.05  # deviation from one, of the rates: far more than a gyroscope has


@dataclass(eq=False)
class _Terms:
    """Of one sensor. `together`: the first so many terms, which are corrected together once all are known."""

    together: int
    known_to: F64  # (K,) standard deviations from which a term is known
    left: F64  # (K,) differences that are not corrected
    value: F64  # (K,) in use
    sigma: F64  # (K,) of what was found last
    used_sigma: F64  # (K,) of what is in use; infinite: it is not corrected

    @staticmethod
    def of(together: int, known_to: F64, left: F64) -> _Terms:
        unknown = np.full(len(left), np.inf)
        return _Terms(together, known_to, left, np.zeros(len(left)), unknown, unknown.copy())

    def take(self, found: F64, sigma: F64) -> bool:
        """Use what was found (K,); returns whether that says something new."""
        known = sigma <= self.known_to
        known[: self.together] = known[: self.together].all()
        wrong = known & (np.abs(found - self.value) > np.maximum(SIGMAS * sigma, self.left))
        better = np.isfinite(self.used_sigma) & (sigma < BETTER * self.used_sigma)
        changed = known & (wrong | better)
        changed[: self.together] = changed[: self.together].any()
        new = bool(changed.any() or (known & ~np.isfinite(self.sigma)).any())
        self.value, self.used_sigma = np.where(changed, found, self.value), np.where(changed, sigma, self.used_sigma)
        self.sigma = np.where(known, sigma, self.sigma)
        return new


class SensorCalibration:
    """Finds the terms of a rig's sensors from the keyframes of a run, in order."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._parts: deque[SensorSamples] = deque()
        self._submap_id = 0
        self._imu, self._wheel = _Terms.of(3, IMU_KNOWN, IMU_KNOWN), _Terms.of(1, WHEEL_KNOWN, WHEEL_LEFT)
        self._due_ns = 0

    @staticmethod
    def from_config(config: Config, rig: Rig) -> SensorCalibration | None:
        """That of a run; None if it is not asked for, or the rig has no sensors."""
        sensors = (rig.imu is not None and config.tracker.inertial) or (rig.wheel is not None and config.tracker.wheels)
        return SensorCalibration(rig) if config.tracker.calibrate_sensors and sensors else None

    def add(self, keyframe: Keyframe, version: int) -> SensorUpdate | None:
        """Add a keyframe; returns what is new. `version`: of the map update that brings it."""
        if keyframe.samples is None or not len(keyframe.samples.stamp_ns):
            return None
        if keyframe.submap_id != self._submap_id:  # its poses do not go with those before
            self._parts.clear()
            self._submap_id = keyframe.submap_id
        if not self._parts:
            self._due_ns = keyframe.stamp_ns + round(FIRST_S * 1e9)
        self._parts.append(keyframe.samples)
        while self._parts and keyframe.stamp_ns - int(self._parts[0].stamp_ns[0]) > WINDOW_S * 1e9:
            self._parts.popleft()
        if not self._parts or keyframe.stamp_ns < self._due_ns:  # none: its own begin before a long gap
            return None
        self._due_ns = keyframe.stamp_ns + round(EVERY_S * 1e9)
        return self._compared(keyframe.kf_id, keyframe.stamp_ns, version)

    def _compared(self, kf_id: int, stamp_ns: int, version: int) -> SensorUpdate | None:
        said: list[Finding] = []
        for compare in (self._compared_imu, self._compared_wheel):
            try:
                said += compare()
            except StereoSfmError:  # too little motion
                continue
        if not said:
            return None
        right = ", ".join(f.name for f in said if f.judged and not f.level)
        parts = [f"{f.name}: {f.text}" for f in said if f.judged and f.level]
        text = "; ".join([*parts, f"confirmed: {right}"] if right else parts)
        imu, wheel = self._imu, self._wheel
        return SensorUpdate(
            version, kf_id, stamp_ns, imu.value.copy(), imu.sigma.copy(), wheel.value.copy(), wheel.sigma.copy(), text
        )

    def _compared_imu(self) -> list[Finding]:
        """What is said of it if that is new."""
        samples, imu = [p.imu for p in self._parts if p.imu is not None], self._rig.imu
        if imu is None or not samples:
            return []
        found = fit_imu(*self._seen(), ImuSamples.joined(samples), imu)
        if found.agreement < AGREEMENT or abs(found.scale - 1) > WRONG_SCALE:
            return []
        turn_sigma = found.imu.left_T_imu[:3, :3].T @ np.diag(found.rotation_sigma**2) @ found.imu.left_T_imu[:3, :3]
        sigma = np.append(np.sqrt(np.diag(turn_sigma)), found.offset_sigma_s)
        return judge_imu(found, imu) if self._imu.take(imu_terms(found, imu), sigma) else []

    def _compared_wheel(self) -> list[Finding]:
        """What is said of them if that is new."""
        samples, wheel = [p.wheel for p in self._parts if p.wheel is not None], self._rig.wheel
        if wheel is None or not samples:
            return []
        found = fit_wheel(*self._seen(), WheelSamples.joined(samples), wheel)
        if found.agreement < AGREEMENT or not self._wheel.take(found.value, found.sigma):
            return []
        return [f for f in judge_wheel(found, wheel) if f.name != "wheels' time offset"]

    def _seen(self) -> tuple[I64, F64]:
        """Stamps (N,) and poses (N, 4, 4) by the images."""
        parts = list(self._parts)
        return np.concatenate([p.stamp_ns for p in parts]), np.concatenate([p.odom_T_cam for p in parts])
