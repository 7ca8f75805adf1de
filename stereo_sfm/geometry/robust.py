"""Seeded random sample consensus over batches of hypotheses, and the exception of degenerate data.

RANSAC: Fischler and Bolles, CACM 24 (1981); scored by truncated squares (MSAC: Torr and Zisserman, CVIU 78, 2000),
which separates hypotheses with equal inlier counts. All hypotheses of a batch are solved and scored as arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereo_sfm.types import F64, I64, Bool


class Degenerate(ValueError):
    """The data do not determine the result. `reason` is a short stable identifier for logs and tables."""

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(f"{reason}: {detail}" if detail else reason)
        self.reason = reason


@dataclass(frozen=True, eq=False)
class Consensus:
    """The best model of a RANSAC and its inliers."""

    model: F64
    inliers: Bool  # (N,)
    residuals: F64  # (N,) in the unit of the threshold


def sample_indices(rng: np.random.Generator, batch: int, count: int, size: int) -> I64:
    """(batch, size) distinct indices below `count` per row."""
    if count <= 64:
        return np.argsort(rng.random((batch, count)), axis=1, kind="stable")[:, :size].astype(np.int64)
    out = rng.integers(0, count, (batch, size))
    for _ in range(20):
        ordered = np.sort(out, axis=1)
        repeated = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
        if not repeated.any():
            break
        out[repeated] = rng.integers(0, count, (int(repeated.sum()), size))
    return out.astype(np.int64)


def needed_samples(inlier_ratio: float, size: int, confidence: float) -> int:
    """Number of samples after which one is free of outliers with probability `confidence`."""
    clean = inlier_ratio**size
    if clean >= 1.0 - 1e-12:
        return 1
    if clean <= 1e-12:
        return 1_000_000_000
    return int(np.ceil(np.log(1.0 - confidence) / np.log(1.0 - clean)))


def ransac(
    count: int,
    sample_size: int,
    solve: Callable[[I64], F64],
    residuals: Callable[[F64], F64],
    threshold: float | F64,
    rng: np.random.Generator,
    *,
    max_samples: int = 512,
    batch: int = 64,
    confidence: float = 0.999,
    min_inliers: int = 8,
    min_ratio: float = 0.0,
) -> Consensus:
    """Best model by truncated squared residuals.

    Args:
        count: number of data points. sample_size: data points per hypothesis.
        solve: (B, sample_size) indices -> (M, ...) models; M may differ from B, models must be finite.
        residuals: (M, ...) models -> (M, N) non-negative residuals (NaN counts as an outlier).
        threshold: largest residual of an inlier, one number or (N,).
        min_inliers, min_ratio: minimum consensus, as a count and as a fraction of `count`.

    Raises:
        Degenerate: "too_few_matches" or "no_consensus".
    """
    if count < max(sample_size, min_inliers):
        raise Degenerate("too_few_matches", f"{count} where {max(sample_size, min_inliers)} are needed")
    limit = np.broadcast_to(np.asarray(threshold, float), (count,))
    best_score, best_model, best_residuals = np.inf, None, np.zeros(0)
    drawn = tried = 0
    needed = max_samples
    while drawn < min(needed, max_samples):
        models = solve(sample_indices(rng, min(batch, max_samples - drawn), count, sample_size))
        drawn += batch
        if len(models) == 0:
            continue
        tried += len(models)
        scaled = residuals(models) / limit
        scores = np.nan_to_num(np.minimum(scaled, 1.0) ** 2, nan=1.0).sum(axis=1)
        winner = int(np.argmin(scores))
        if scores[winner] < best_score:
            best_score, best_model, best_residuals = float(scores[winner]), models[winner], scaled[winner]
            needed = needed_samples(float((best_residuals <= 1.0).mean()), sample_size, confidence)
    inliers: Bool = np.asarray(best_residuals <= 1.0) if best_model is not None else np.zeros(count, bool)
    if best_model is None or inliers.sum() < max(min_inliers, min_ratio * count):
        raise Degenerate("no_consensus", f"{int(inliers.sum())} of {count} agree")
    return Consensus(best_model, inliers, best_residuals * limit)
