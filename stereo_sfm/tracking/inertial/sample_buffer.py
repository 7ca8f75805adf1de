"""Inertial samples of the last seconds, corrected, on the camera's clock, ready to be integrated between any times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.imu import Imu
from stereo_sfm.types import F64, I64, ImuSamples

MEMORY_S = 2.0  # how far back intervals may begin, besides the time since the last pose
MAX_GAP_S = 0.05  # between samples: longer ones are not bridged


@dataclass(frozen=True, eq=False)
class Intervals:
    """Successive stretches of constant rates."""

    seconds: F64  # (N,)
    gyro: F64  # (N, 3) rad/s
    accel: F64  # (N, 3) m/s^2


class SampleBuffer:
    """Samples that are missing, doubled or out of order only shorten what can be integrated."""

    def __init__(self, imu: Imu) -> None:
        self._imu = imu
        self._stamp_ns: I64 = np.zeros(0, np.int64)
        self._gyro: F64 = np.zeros((0, 3))
        self._accel: F64 = np.zeros((0, 3))
        self._accel_stamp_ns: I64 = np.zeros(0, np.int64)  # of the accelerometer alone, the last ones
        self._accel_alone: F64 = np.zeros((0, 3))

    def add(self, samples: ImuSamples) -> None:
        """The next samples; accelerations are interpolated at the times of the gyroscope."""
        stamps = samples.stamp_ns - round(self._imu.offset_s * 1e9)
        gyro, accel = self._imu.correct(samples.gyro, samples.accel)
        turned, pushed = np.isfinite(gyro).all(axis=1), np.isfinite(accel).all(axis=1)
        self._accel_stamp_ns = np.concatenate([self._accel_stamp_ns[-1:], stamps[pushed]])
        self._accel_alone = np.concatenate([self._accel_alone[-1:], accel[pushed]])
        later = turned & (stamps > (self._stamp_ns[-1] if len(self._stamp_ns) else np.iinfo(np.int64).min))
        rows = np.flatnonzero(later)
        if not len(rows) or not len(self._accel_stamp_ns):
            return
        rows = rows[np.concatenate([[True], np.diff(stamps[rows]) > 0])]
        at = np.stack([np.interp(stamps[rows], self._accel_stamp_ns, a) for a in self._accel_alone.T], axis=1)
        self._stamp_ns = np.concatenate([self._stamp_ns, stamps[rows]])
        self._gyro = np.concatenate([self._gyro, gyro[rows]])
        self._accel = np.concatenate([self._accel, at])

    def forget(self, before_ns: int) -> None:
        """Samples from before a time are no longer needed."""
        first = int(np.searchsorted(self._stamp_ns, before_ns - round(MEMORY_S * 1e9)))
        if first > len(self._stamp_ns) // 2:
            self._stamp_ns, self._gyro = self._stamp_ns[first:].copy(), self._gyro[first:].copy()
            self._accel = self._accel[first:].copy()

    def between(self, begin_ns: int, end_ns: int) -> Intervals | None:
        """From one time to a later one, by the trapezoidal rule; None where samples are missing."""
        first = int(np.searchsorted(self._stamp_ns, begin_ns, side="right")) - 1
        last = int(np.searchsorted(self._stamp_ns, end_ns, side="left"))
        rows = slice(max(first, 0), last + 1)
        stamps = self._stamp_ns[rows]
        if end_ns <= begin_ns or len(stamps) < 2:
            return None
        edges = np.concatenate([[begin_ns], stamps[(stamps > begin_ns) & (stamps < end_ns)], [end_ns]])
        nearest = np.concatenate([[begin_ns], stamps, [end_ns]]) if first < 0 else np.concatenate([stamps, [end_ns]])
        if np.diff(nearest).max() > MAX_GAP_S * 1e9:
            return None
        origin = stamps[0]
        at = (edges - origin).astype(float)
        known = (stamps - origin).astype(float)
        gyro = np.stack([np.interp(at, known, column) for column in self._gyro[rows].T], axis=1)
        accel = np.stack([np.interp(at, known, column) for column in self._accel[rows].T], axis=1)
        return Intervals(np.diff(edges) * 1e-9, 0.5 * (gyro[1:] + gyro[:-1]), 0.5 * (accel[1:] + accel[:-1]))
