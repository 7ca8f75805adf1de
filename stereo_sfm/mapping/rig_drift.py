"""Terms of the rig that change steadily (temperature), estimated from windows of keyframes.

Every window sees another scene, with a systematic error of matching of its own. How large the errors of the change are
is not assumed but seen: from the windows' scatter around it. An error that all windows share does not show there; it is
one of the terms, not of their change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.choice import Estimate
from stereo_sfm.mapping.rig_window import PRIOR, RigWindow
from stereo_sfm.types import F64, RIG_TERMS, Bool

RATE = np.deg2rad(0.1) / 60.0  # prior standard deviation of drift, radians (ratio) per second


@dataclass(frozen=True, eq=False)
class SteadyChange:
    """Of the terms, over a time."""

    end: F64  # (8,) difference from the current terms at the end
    change: F64  # (8,) from beginning to end
    covariance: F64  # (16, 16) of both, from what windows state
    scatter: float  # of the windows around the change, over that
    systematic: F64  # (8,) standard deviations of errors that all windows share

    @property
    def estimate(self) -> Estimate:
        """The change."""
        return Estimate(self.change, self.scatter * self.covariance[RIG_TERMS:, RIG_TERMS:])

    def at_the_end(self, changing: Bool) -> Estimate:
        """The difference at the end if only the terms `changing` (8,) change."""
        still = RIG_TERMS + np.flatnonzero(~changing)
        gain = np.linalg.solve(self.covariance[still][:, still], self.covariance[still, :RIG_TERMS]).T
        covariance = self.covariance[:RIG_TERMS, :RIG_TERMS] - gain @ self.covariance[still, :RIG_TERMS]
        return Estimate(self.end - gain @ self.change[~changing], covariance + np.diag(self.systematic**2))


def steady_change(
    windows: Sequence[RigWindow], span: Sequence[RigWindow], current: F64, systematic: F64
) -> SteadyChange:
    """The change over `span`.

    Args:
        windows: three at least, within `span`. current: (8,) terms, the prior's.
        systematic: (8,) standard deviations of a window's systematic error.
    """
    end_ns, seconds = span[-1].stamp_ns, (span[-1].stamp_ns - span[0].stamp_ns) * 1e-9
    axes = np.array([[1.0, (w.stamp_ns - end_ns) * 1e-9 / seconds] for w in windows])
    matrices = np.stack([w.information.matrix for w in windows])
    kept = np.eye(RIG_TERMS) - matrices @ np.linalg.inv(matrices + np.diag(systematic**-2))
    matrices = kept @ matrices
    vectors = np.stack([k @ w.information.vector for k, w in zip(kept, windows, strict=True)])
    prior = np.concatenate([PRIOR**-2, np.full(RIG_TERMS, (RATE * seconds) ** -2)])
    total = np.diag(prior) + np.einsum("ni,nj,nab->iajb", axes, axes, matrices).reshape(2 * [2 * RIG_TERMS])
    vector = (axes.T @ vectors).ravel() + prior * np.concatenate([current, np.zeros(RIG_TERMS)])
    covariance = np.asarray(np.linalg.inv(total), float)
    line = (covariance @ vector).reshape(2, RIG_TERMS)
    scatter = _misfit(matrices, vectors, axes @ line) / (len(windows) - 2)
    return SteadyChange(line[0] - current, line[1], covariance, scatter, systematic)


def _misfit(matrices: F64, vectors: F64, terms: F64) -> float:
    """Chi-squared of terms (N, 8) with the information of N windows, over the number of terms that they determine."""
    left = vectors - np.einsum("nab,nb->na", matrices, terms)
    inverses = np.asarray(np.linalg.pinv(matrices, hermitian=True), float)
    determined = (np.diagonal(matrices[0]) > 0).sum()
    return float(np.einsum("na,nab,nb->", left, inverses, left) / determined)
