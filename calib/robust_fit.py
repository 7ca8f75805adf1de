"""Robust least squares with standard deviations, and the time shift between two signals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereo_sfm.types import F64

HUBER = 2.0  # standard deviations beyond which a residual counts linearly
ROUNDS = 4  # each with the spread that the last one left
STEP = 1e-3  # of a typical change, for derivatives
BLOCKS = 8  # of successive residuals: errors of neighbours are alike, those of blocks are not


@dataclass(frozen=True, eq=False)
class Fit:
    """A solution and its standard deviation."""

    value: F64  # (K,)
    sigma: F64  # (K,)


def robust_fit(residual: Callable[[F64], F64], start: F64, scales: F64) -> Fit:
    """Minimise residuals (N, D) with a Huber loss, whose width follows from their spread.

    The standard deviations are those of the solutions without one block of residuals each (a jackknife over blocks),
    from one linear step: unlike those of independent residuals they hold for errors that last.

    Args:
        residual: of parameters (K,), rows in the order of time. start: (K,). scales: (K,) typical changes.
    """
    from scipy.optimize import least_squares

    x = start
    for _ in range(ROUNDS):
        spread = 1.4826 * np.median(np.abs(residual(x)), axis=0) + 1e-12  # (D,)
        found = least_squares(  # from zero: the first step may be as long as the start, however near zero that is
            lambda u, x=x, s=spread: (residual(x + u * scales) / s).ravel(),
            np.zeros(len(x)),
            lambda u, x=x, s=spread: (_derivatives(residual, x + u * scales, scales) / s[:, None]).reshape(-1, len(x)),  # pyright: ignore[reportArgumentType]
            loss="huber",
            f_scale=HUBER,
        )
        x = x + scales * np.asarray(found.x, np.float64)
    return Fit(x, _jackknife(residual, x, scales))


def _derivatives(residual: Callable[[F64], F64], x: F64, scales: F64) -> F64:
    """(N, D, K) by parameters over their scales. A step relative to a parameter would be none where it is nearly 0."""
    ends = [(residual(x + h), residual(x - h)) for h in STEP * np.diag(scales)]
    return np.stack([(high - low) / (2 * STEP) for high, low in ends], axis=-1)


def _jackknife(residual: Callable[[F64], F64], x: F64, scales: F64) -> F64:
    """(K,) standard deviations."""
    rows, jacobian = residual(x), _derivatives(residual, x, scales)
    spread = 1.4826 * np.median(np.abs(rows), axis=0) + 1e-12
    weight = 1.0 / np.maximum(np.abs(rows / spread) / HUBER, 1.0) / spread**2
    blocks = np.array_split(np.arange(len(rows)), BLOCKS)
    normals = np.array([np.einsum("nd,ndi,ndj->ij", weight[b], jacobian[b], jacobian[b]) for b in blocks])
    rhs = np.array([np.einsum("nd,ndi,nd->i", weight[b], jacobian[b], rows[b]) for b in blocks])
    without = normals.sum(axis=0) - normals + 1e-9 * np.eye(len(x))
    off = -np.linalg.solve(without, (rhs.sum(axis=0) - rhs)[..., None])[..., 0]
    spread2 = ((off - off.mean(axis=0)) ** 2).sum(axis=0)
    return np.asarray(np.sqrt((BLOCKS - 1) / BLOCKS * spread2) * scales, np.float64)


def shift_between(
    first: Callable[[F64], F64], second: F64, seconds: F64, reach_s: float, step_s: float = 0.005
) -> float:
    """Seconds by which a signal must be read later to resemble another one most (largest correlation).

    Args:
        first: the signal at times (N,). second: (N,) the other one at times `seconds` (N,). reach_s: largest shift.
    """
    shifts = np.arange(-reach_s, reach_s + step_s / 2, step_s)
    other = second - second.mean()
    return float(shifts[int(np.argmax([_correlation(first(seconds + s), other) for s in shifts]))])


def _correlation(signal: F64, other: F64) -> float:
    moved = signal - signal.mean()
    return float(moved @ other / (np.linalg.norm(moved) * np.linalg.norm(other) + 1e-12))


class Whitening:
    """Makes successive errors with covariances between near ones independent, by the Cholesky factor of those."""

    def __init__(self, covariances: F64) -> None:
        """`covariances`: (B,) of an error with itself, the next one, and so on; none further apart."""
        self._covariances = covariances
        self._factor: F64 = np.zeros((0, 0))

    def __call__(self, errors: F64) -> F64:
        """(N, D) -> (N, D)."""
        from scipy.linalg import cholesky_banded, solve_banded

        if self._factor.shape[1] != len(errors):
            bands = np.repeat(self._covariances[:, None], len(errors), axis=1)
            self._factor = np.asarray(cholesky_banded(bands, lower=True), np.float64)
        return np.asarray(solve_banded((len(self._factor) - 1, 0), self._factor, errors), np.float64)
