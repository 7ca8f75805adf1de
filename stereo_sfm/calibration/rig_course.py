"""The course of the rig's terms over the windows of a run: constant, with a step, or steady (temperature).

Every window sees another scene while the camera turns in another way, through lenses that no model describes to the
last and on a mount that may give: its terms differ from the rig's by more than the noise of its pixels. By how much is
not assumed but estimated from the scatter of the windows, as a random effect of each (expectation-maximisation:
Dempster, Laird and Rubin, J. R. Stat. Soc. B 39, 1977), together with what turning adds. Neighbouring windows see the
same points in the same turn: how alike their errors are is estimated, too, and enlarges the deviations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.choice import Estimate
from stereo_sfm.calibration.rig_window import PRIOR, RigWindow
from stereo_sfm.types import F64, RIG_TERMS, Bool

ITERATIONS = 12  # of expectation-maximisation, until the scatter hardly changes
PRIOR_WINDOWS = 8.0  # as many windows as what is expected of their scatter at first counts for
# Correlation of neighbouring windows before they show theirs; the most that is estimated: deviations stay finite.
ALIKE, MOST_ALIKE = 0.3, 0.9
# Prior standard deviation of what a turn adds, radian and ratio per radian: errors of lenses bend the flow of a turning
# camera as errors of disparity do, and hardly move rows. The root mean square of eight real recordings.
BY_TURN = np.array([3e-4, 1.5e-3, 7e-4, 3e-4, 3e-4, 2e-3, 3e-4, 3e-4])
RATE = np.deg2rad(0.1) / 60.0  # prior standard deviation of drift, radians (ratio) per second: of temperature


@dataclass(frozen=True, eq=False)
class Course:
    """Columns times coefficients are the terms; each window has an own error besides."""

    value: F64  # (K, 8) coefficients
    covariance: F64  # (8 K, 8 K)
    freedom: float  # degrees of freedom of the covariance's scale

    def at(self, column: Sequence[float]) -> Estimate:
        """The terms where the columns (K,) have these values."""
        axes = np.kron(column, np.eye(RIG_TERMS))
        return Estimate(axes @ self.value.ravel(), axes @ self.covariance @ axes.T, self.freedom)

    def with_zero(self, column: int, terms: Bool) -> Course:
        """If the coefficients of `terms` (8,) in a column are zero: the conditional Gaussian."""
        at = column * RIG_TERMS + np.flatnonzero(terms)
        gain = np.linalg.solve(self.covariance[at][:, at], self.covariance[at]).T
        value = self.value.ravel() - gain @ self.value.ravel()[at]
        covariance = self.covariance - gain @ self.covariance[at] + 1e-20 * np.eye(len(value))
        return Course(value.reshape(-1, RIG_TERMS), covariance, self.freedom)


def course(windows: Sequence[RigWindow], columns: F64, prior: F64, expected: F64) -> Course:
    """The course of the terms over windows.

    Args:
        windows: one at least. columns: (N, K) of them, to which their turns are added here.
        prior: (K, 8) standard deviations of the coefficients around zero.
        expected: (8, 8) covariance of the windows' own errors before these show it.
    """
    count, kinds = columns.shape
    columns = np.concatenate([columns, [w.turn for w in windows]], axis=1)
    by_turn = BY_TURN.copy()
    by_turn[[1, windows[0].across]] = BY_TURN[[windows[0].across, 1]]
    precision = np.diag(np.concatenate([prior, np.tile(by_turn, (3, 1))]).ravel() ** -2)
    matrices = np.stack([w.information.matrix for w in windows])
    vectors = np.stack([w.information.vector for w in windows])
    axes = np.einsum("nk,ab->nakb", columns, np.eye(RIG_TERMS)).reshape(count, RIG_TERMS, -1)
    scatter, freedom = expected, PRIOR_WINDOWS + count
    value, covariance, error = np.zeros(axes.shape[-1]), precision, np.zeros((count, RIG_TERMS))
    for _ in range(ITERATIONS):
        own = np.linalg.inv(matrices + np.linalg.inv(scatter))  # covariance of a window's own error
        kept = np.eye(RIG_TERMS) - matrices @ own
        weighted = (kept @ matrices) @ axes
        covariance = np.linalg.inv(np.tensordot(axes, weighted, ((0, 1), (0, 1))) + precision)
        value = covariance @ np.tensordot(axes, (kept @ vectors[..., None])[..., 0], ((0, 1), (0, 1)))
        error = (own @ (vectors - (matrices @ (axes @ value)[..., None])[..., 0])[..., None])[..., 0]
        moved = own @ matrices @ axes  # own errors by the coefficients
        squares = np.einsum("na,nb->ab", error, error) + (own + moved @ covariance @ moved.transpose(0, 2, 1)).sum(0)
        scatter = (PRIOR_WINDOWS * expected + squares) / freedom
    alike = _alike(error, scatter)
    size = kinds * RIG_TERMS
    grown = 1 + 2 * alike / (1 - alike) * (1 - 1 / count)  # of a mean of alike errors
    values, covariance = np.asarray(value[:size], float).reshape(kinds, RIG_TERMS), np.asarray(covariance, float)
    return Course(values, grown * covariance[:size, :size], freedom - kinds)


def _alike(error: F64, scatter: F64) -> float:
    """Correlation of the errors (N, 8) of neighbouring windows, from 0 to MOST_ALIKE.

    That of N errors around their mean is too small by (1 + 4 r) / N (Kendall, Biometrika 41, 1954).
    """
    count, scaled = len(error), error / np.sqrt(np.diag(scatter))
    shown = (scaled[1:] * scaled[:-1]).sum() / max((scaled**2).sum(), 1e-12)
    shown += (1 + 4 * shown) / count
    return float(np.clip((PRIOR_WINDOWS * ALIKE + count * shown) / (PRIOR_WINDOWS + count), 0.0, MOST_ALIKE))


def constant(windows: Sequence[RigWindow], expected: F64) -> Course:
    """One column: a rig that does not change."""
    return course(windows, np.ones((len(windows), 1)), PRIOR[None], expected)


def steady(windows: Sequence[RigWindow], span: Sequence[RigWindow], expected: F64) -> Course:
    """Two columns: the terms at the end of `span`, and their change over it."""
    end_ns, seconds = span[-1].stamp_ns, (span[-1].stamp_ns - span[0].stamp_ns) * 1e-9
    columns = np.array([[1.0, (w.stamp_ns - end_ns) * 1e-9 / seconds] for w in windows])
    return course(windows, columns, np.stack([PRIOR, np.full(RIG_TERMS, RATE * seconds)]), expected)
