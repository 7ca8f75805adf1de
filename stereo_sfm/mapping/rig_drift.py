"""Terms of the rig that change steadily (temperature), estimated from windows of keyframes.

Every window sees another scene, with a systematic error of matching of its own. How large the errors of windows are is
not assumed but seen: from their scatter around the change. An error that all windows share does not show there; it is
added to the terms at the end, not to their change.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereo_sfm.calib.choice import Estimate
from stereo_sfm.mapping.rig_window import PRIOR, RigWindow
from stereo_sfm.types import F64, RIG_TERMS

RATE = np.deg2rad(0.1) / 60.0  # prior standard deviation of drift, radians (ratio) per second


def steady_change(
    windows: Sequence[RigWindow], span: Sequence[RigWindow], current: F64, systematic: F64
) -> tuple[Estimate, Estimate]:
    """How the terms at the end of `span` differ from the current ones, and their change from its beginning to its end.

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
    end, change = (covariance @ vector).reshape(2, RIG_TERMS)
    covariance *= _misfit(matrices, vectors, axes @ np.stack([end, change])) / (len(windows) - 2)
    at_end = covariance[:RIG_TERMS, :RIG_TERMS] + np.diag(systematic**2)
    return Estimate(end - current, at_end), Estimate(change, covariance[RIG_TERMS:, RIG_TERMS:])


def _misfit(matrices: F64, vectors: F64, terms: F64) -> float:
    """Chi-squared of terms (N, 8) with the information of N windows, over the number of terms that they determine."""
    left = vectors - np.einsum("nab,nb->na", matrices, terms)
    inverses = np.asarray(np.linalg.pinv(matrices, hermitian=True), float)
    determined = (np.diagonal(matrices[0]) > 0).sum()
    return float(np.einsum("na,nab,nb->", left, inverses, left) / determined)
