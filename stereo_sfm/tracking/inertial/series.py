"""Sampled signals of the last seconds, ready to be integrated between any times."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.types import F64, I64

MEMORY_S = 2.0  # how far back intervals may begin, besides the time since the last pose


class Series:
    """Samples with ascending stamps; what is missing only shortens what can be integrated."""

    def __init__(self, columns: int, max_gap_s: float) -> None:
        """Args:
        columns: of a sample. max_gap_s: between samples; longer ones are not bridged.
        """
        self._max_gap_ns = max_gap_s * 1e9
        self.stamp_ns: I64 = np.zeros(0, np.int64)
        self._values: F64 = np.zeros((0, columns))

    def after_last(self, stamp_ns: I64) -> I64:
        """Rows of new stamps (N,) that are later than all before them in turn."""
        last = self.stamp_ns[-1] if len(self.stamp_ns) else np.iinfo(np.int64).min
        before = np.maximum.accumulate(np.concatenate([[last], stamp_ns]))[:-1]
        return np.flatnonzero(stamp_ns > before)

    def add(self, stamp_ns: I64, values: F64) -> None:
        """The next samples, ascending."""
        self.stamp_ns = np.concatenate([self.stamp_ns, stamp_ns])
        self._values = np.concatenate([self._values, values])

    def forget(self, before_ns: int) -> None:
        """Samples from before a time are no longer needed."""
        first = int(np.searchsorted(self.stamp_ns, before_ns - round(MEMORY_S * 1e9)))
        if first > len(self.stamp_ns) // 2:
            self.stamp_ns, self._values = self.stamp_ns[first:].copy(), self._values[first:].copy()

    def edges(self, begin_ns: int, end_ns: int) -> I64 | None:
        """(N + 1,) times from one to a later one, those of the samples between; None where samples are missing."""
        stamps = self.stamp_ns[self._rows(begin_ns, end_ns)]
        if end_ns <= begin_ns or not len(stamps):
            return None
        before = stamps[0] <= begin_ns
        nearest = np.concatenate([stamps, [end_ns]] if before else [[begin_ns], stamps, [end_ns]])
        if np.diff(nearest).max() > self._max_gap_ns:
            return None
        return np.concatenate([[begin_ns], stamps[(stamps > begin_ns) & (stamps < end_ns)], [end_ns]])

    def means(self, edges_ns: I64) -> F64:
        """(N, K) mean values between successive times (N + 1,), by the trapezoidal rule."""
        rows = self._rows(int(edges_ns[0]), int(edges_ns[-1]))
        return _means(self.stamp_ns[rows], self._values[rows], edges_ns)

    def _rows(self, begin_ns: int, end_ns: int) -> slice:
        """The samples from the last one before an interval to the first one after it."""
        first = int(np.searchsorted(self.stamp_ns, begin_ns, side="right")) - 1
        last = int(np.searchsorted(self.stamp_ns, end_ns, side="left"))
        return slice(max(first, 0), last + 1)


@njit
def _means(stamp_ns, values, edges_ns):
    """Means (N, K) between times (N + 1,) of values (M, K) at stamps (M,): linear between them, constant beyond."""
    at = np.empty((len(edges_ns), values.shape[1]))
    for n in range(len(edges_ns)):
        k = min(max(np.searchsorted(stamp_ns, edges_ns[n], side="right") - 1, 0), max(len(stamp_ns) - 2, 0))
        after = min(k + 1, len(stamp_ns) - 1)
        share = (edges_ns[n] - stamp_ns[k]) / max(stamp_ns[after] - stamp_ns[k], 1)
        share = min(max(share, 0.0), 1.0)
        for i in range(values.shape[1]):
            at[n, i] = values[k, i] + share * (values[after, i] - values[k, i])
    return 0.5 * (at[1:] + at[:-1])
