"""Sampled signals of the last seconds, ready to be integrated between any times."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.imu import Imu
from stereo_sfm.geometry.kernels import inner, njit
from stereo_sfm.types import F64, I64, ImuSamples

MAX_GAP_S = 0.05  # between inertial samples: longer ones are not bridged
STALLED_S = 0.5  # without an acceleration: an accelerometer, which may be slower than its gyroscope, has stopped
MEMORY_S = 4.0  # how far back intervals may begin, besides the time since the last pose
LONGEST_S = 120.0  # without a pose, for which samples are kept: in the dark each image would take longer than the last


class Series:
    """Samples of two vectors with ascending stamps; what is missing only shortens what can be integrated."""

    def __init__(self, max_gap_s: float) -> None:
        """`max_gap_s`: between samples; longer ones are not bridged."""
        self._max_gap_ns = max_gap_s * 1e9
        self.stamp_ns: I64 = np.zeros(0, np.int64)
        self._values: F64 = np.zeros((0, 6))

    def after_last(self, stamp_ns: I64) -> I64:
        """Rows of new stamps (N,) that are later than all before them in turn."""
        last = self.stamp_ns[-1] if len(self.stamp_ns) else np.iinfo(np.int64).min
        before = np.maximum.accumulate(np.concatenate([[last], stamp_ns]))[:-1]
        return np.flatnonzero(stamp_ns > before)

    def add(self, stamp_ns: I64, values: F64) -> None:
        """The next samples, ascending."""
        self.stamp_ns = np.concatenate([self.stamp_ns, stamp_ns])
        self._values = np.concatenate([self._values, values])
        if len(self.stamp_ns):
            self.forget(int(self.stamp_ns[-1]) - round(LONGEST_S * 1e9))

    def forget(self, before_ns: int) -> None:
        """Samples from before a time are no longer needed."""
        first = int(np.searchsorted(self.stamp_ns, before_ns - round(MEMORY_S * 1e9)))
        if first > len(self.stamp_ns) // 2:
            self.stamp_ns, self._values = self.stamp_ns[first:].copy(), self._values[first:].copy()

    def edges(self, begin_ns: int, end_ns: int) -> I64 | None:
        """(N + 1,) times from one to a later one, those of the samples between; None where samples are missing."""
        found = _edges(self.stamp_ns, begin_ns, end_ns, self._max_gap_ns)
        return found if len(found) else None

    def means(self, edges_ns: I64) -> F64:
        """(N, K) mean values between successive times (N + 1,), by the trapezoidal rule."""
        return _means(self.stamp_ns, self._values, edges_ns)


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
    """Corrected inertial samples on the camera's clock; what is missing, doubled or out of order only shortens them."""

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
        if len(self._accel_stamp_ns):  # what it showed last is not what it would show now
            rows = rows[stamps[rows] <= self._accel_stamp_ns[-1] + round(STALLED_S * 1e9)]
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


@inner
def _rows(stamp_ns, begin_ns, end_ns):
    """From the last sample before an interval to the one after the first behind it."""
    first = max(np.searchsorted(stamp_ns, begin_ns, side="right") - 1, 0)
    return first, min(np.searchsorted(stamp_ns, end_ns, side="left") + 1, len(stamp_ns))


@njit
def _edges(stamp_ns, begin_ns, end_ns, max_gap_ns):
    """As `Series.edges`; (0,) where samples (M,) are missing."""
    first, last = _rows(stamp_ns, begin_ns, end_ns)
    out, n = np.empty(max(last - first, 0) + 2, np.int64), 1
    if end_ns <= begin_ns or last <= first:
        return out[:0]
    before = min(begin_ns, stamp_ns[first])
    out[0] = begin_ns
    for k in range(first, last):
        if stamp_ns[k] - before > max_gap_ns:
            return out[:0]
        before = stamp_ns[k]
        if begin_ns < before < end_ns:
            out[n] = before
            n += 1
    out[n] = end_ns
    return out[: n + 1] if end_ns - before <= max_gap_ns else out[:0]


@njit
def _means(stamp_ns, values, edges_ns):
    """Means (N, K) between times (N + 1,) of values (M, K) at stamps (M,): linear between them, constant beyond."""
    first, last = _rows(stamp_ns, edges_ns[0], edges_ns[-1])
    stamp_ns, values = stamp_ns[first:last], values[first:last]
    at = np.empty((len(edges_ns), values.shape[1]))
    for n in range(len(edges_ns)):
        k = min(max(np.searchsorted(stamp_ns, edges_ns[n], side="right") - 1, 0), max(len(stamp_ns) - 2, 0))
        after = min(k + 1, len(stamp_ns) - 1)
        share = (edges_ns[n] - stamp_ns[k]) / max(stamp_ns[after] - stamp_ns[k], 1)
        share = min(max(share, 0.0), 1.0)
        for i in range(values.shape[1]):
            at[n, i] = values[k, i] + share * (values[after, i] - values[k, i])
    return 0.5 * (at[1:] + at[:-1])
