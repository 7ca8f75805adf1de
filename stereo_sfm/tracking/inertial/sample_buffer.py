"""Inertial samples of the last seconds, corrected, on the camera's clock, ready to be integrated between any times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.imu import Imu
from stereo_sfm.tracking.inertial.series import Series
from stereo_sfm.types import F64, I64, ImuSamples

MAX_GAP_S = 0.05  # between samples: longer ones are not bridged


@dataclass(frozen=True, eq=False)
class Intervals:
    """Successive stretches of constant rates."""

    edges_ns: I64  # (N + 1,)
    gyro: F64  # (N, 3) rad/s
    accel: F64  # (N, 3) m/s^2

    @property
    def seconds(self) -> F64:
        """(N,) length of each."""
        return np.diff(self.edges_ns) * 1e-9


class SampleBuffer:
    """Samples that are missing, doubled or out of order only shorten what can be integrated."""

    def __init__(self, imu: Imu) -> None:
        self._imu = imu
        self._series = Series(MAX_GAP_S)
        self._accel_stamp_ns: I64 = np.zeros(0, np.int64)  # of the accelerometer alone, the last ones
        self._accel_alone: F64 = np.zeros((0, 3))

    @property
    def newest_ns(self) -> int | None:
        """The stamp of the newest sample on the camera's clock; None without any."""
        return int(self._series.stamp_ns[-1]) if len(self._series.stamp_ns) else None

    def add(self, samples: ImuSamples) -> None:
        """The next samples; accelerations are interpolated at the times of the gyroscope."""
        stamps = samples.stamp_ns - round(self._imu.offset_s * 1e9)
        gyro, accel = self._imu.correct(samples.gyro, samples.accel)
        turned, pushed = np.isfinite(gyro).all(axis=1), np.isfinite(accel).all(axis=1)
        self._accel_stamp_ns = np.concatenate([self._accel_stamp_ns[-1:], stamps[pushed]])
        self._accel_alone = np.concatenate([self._accel_alone[-1:], accel[pushed]])
        stamps, gyro = stamps[turned], gyro[turned]
        rows = self._series.after_last(stamps)
        if len(rows) and len(self._accel_stamp_ns):
            at = [np.interp(stamps[rows], self._accel_stamp_ns, a) for a in self._accel_alone.T]
            self._series.add(stamps[rows], np.column_stack([gyro[rows], *at]))

    def forget(self, before_ns: int) -> None:
        """Samples from before a time are no longer needed."""
        self._series.forget(before_ns)

    def between(self, begin_ns: int, end_ns: int) -> Intervals | None:
        """From one time to a later one; None where samples are missing."""
        edges = self._series.edges(begin_ns, end_ns)
        if edges is None:
            return None
        values = self._series.means(edges)
        return Intervals(edges, values[:, :3], values[:, 3:])
