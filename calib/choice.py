"""Which terms of a correction are significant enough to be written into a calibration: those beyond several standard
deviations that each half of the recording confirms on its own. Other terms stay unchanged, and the significant ones
are estimated with the others held."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.scene_model import DIRECTION, FOCAL_RIGHT, ROTATION, SHARED, decentered, moved
from stereo_sfm.types import F64, RIG_TERMS, Bool

# Rotation of the right camera (3), direction of the baseline (2), focal length of the right relative to the left,
# decentering of the right lens relative to the left (2).
NAMES = (
    *(f"rotation of the right camera about {axis}" for axis in "xyz"),
    *(f"baseline direction, {axis}" for axis in "yz"),
    "focal length, right relative to left",
    *(f"decentering of the right lens along {axis}" for axis in "xy"),
)
UNITS = (*["degrees"] * 5, "%", *["degrees"] * 2)
SCALES = np.array([*[np.rad2deg(1.0)] * 5, 100.0, *[np.rad2deg(1.0)] * 2])  # from radians and ratios to UNITS
ROLLING_SHUTTER_MIMICS = np.array(
    [False, True, False, True, True, False, True, True]
)  # terms that motion with a rolling shutter can mimic
SIGMAS = 4.0  # standard deviations from zero that make a term significant
NONE, ALL = np.zeros(RIG_TERMS, bool), np.ones(RIG_TERMS, bool)
MIN_SHARE_IN_HALVES = 0.5  # of a term's value that each half of the recording must show, with the same sign


def with_terms(rig: Rig, value: F64) -> Rig:
    """The rig with the terms (8,) added; the same object when they are zero."""
    if not value.any():
        return rig
    vector = np.zeros(SHARED)
    vector[ROTATION], vector[DIRECTION], vector[FOCAL_RIGHT] = value[:3], value[3:5], value[5]
    return decentered(moved(rig, vector), float(value[6]), float(value[7]))


@dataclass(frozen=True, eq=False)
class Estimate:
    """The terms estimated from one set of matches."""

    value: F64  # (8,) radians; the focal length's is a ratio
    covariance: F64  # (8, 8)
    freedom: float = np.inf  # degrees of freedom of the covariance's scale

    @functools.cached_property
    def information(self) -> tuple[F64, F64]:
        """(8, 8) inverse of the covariance, and (8,) its product with the value."""
        matrix = np.asarray(np.linalg.pinv(self.covariance, hermitian=True), float)
        return matrix, matrix @ self.value

    def without(self, kept: Bool) -> Estimate:
        """The estimate with the terms that are not `kept` (8,) held at zero: the conditional Gaussian."""
        if kept.all():
            return self
        matrix, vector = self.information
        at = np.flatnonzero(kept)
        inside = np.linalg.inv(matrix[at][:, at])
        value, covariance = np.zeros(RIG_TERMS), np.zeros((RIG_TERMS, RIG_TERMS))
        value[at], covariance[at[:, None], at] = inside @ vector[at], inside
        return Estimate(value, covariance, self.freedom)

    def by(self, basis: F64) -> Estimate:
        """The estimate of `basis` (8, 8) times the terms."""
        return Estimate(basis @ self.value, basis @ self.covariance @ basis.T, self.freedom)

    def ignoring(self, terms: Bool) -> Estimate:
        """The estimate with `terms` (8,) unknown, whatever is held: the marginal Gaussian of the others."""
        known = np.diag(np.where(terms, 0.0, 1.0))
        unknown = np.diag(np.where(terms, np.diag(self.covariance), 0.0))
        return Estimate(known @ self.value, known @ self.covariance @ known + unknown, self.freedom)

    @property
    def sigma(self) -> F64:
        """(8,) standard deviations."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @functools.cached_property
    def strength(self) -> F64:
        """(8,) values in standard deviations of a Gaussian that are as unlikely: the covariance may be known badly."""
        return self._gaussian(np.abs(self.value) / np.maximum(self.sigma, 1e-12))

    @property
    def reach(self) -> float:
        """Mahalanobis distance from zero. No term's strength exceeds it, whichever of the others are held.

        The covariance must be definite.
        """
        if not self.value.any():
            return 0.0
        return float(self._gaussian(np.sqrt(self.value @ np.linalg.solve(self.covariance, self.value))))

    def _gaussian(self, deviations: F64) -> F64:
        """Of Student's distribution as those of a Gaussian of the same probability (Wallace, Biometrika 46, 1959)."""
        if np.isinf(self.freedom):
            return deviations
        return np.sqrt(self.freedom * np.log1p(deviations**2 / self.freedom))


@dataclass(frozen=True)
class Term:
    """One term, whether it is written, and why; numbers in `unit`."""

    name: str
    unit: str
    value: float
    sigma: float
    halves: tuple[float, ...]
    selected: bool
    why: str

    @property
    def line(self) -> str:
        """One readable line."""
        what = f"{self.value:+.3f} +- {self.sigma:.3f} {self.unit}"
        return f"{self.name}: {'written' if self.selected else 'unchanged'}, {what} ({self.why})"


@dataclass(frozen=True, eq=False)
class Choice:
    """The significant terms."""

    terms: tuple[Term, ...]
    value: F64  # (8,) zero where nothing is written
    sigma: F64  # (8,) standard deviations of all terms, written or not
    selected: Bool  # (8,)

    def apply(self, rig: Rig) -> Rig:
        """The corrected rig; the same object when nothing is written."""
        return with_terms(rig, self.value)


def choose(
    whole: Estimate,
    halves: Sequence[Estimate],
    rolling: bool = False,
    sigmas: float | F64 = SIGMAS,
    confirmed: Bool = NONE,
) -> Choice:
    """The significant terms of `whole`, with what speaks for and against each; arguments as those of `significant`."""
    needed, kept = np.broadcast_to(sigmas, RIG_TERMS), significant(whole, halves, rolling, sigmas, confirmed)
    final = whole.without(kept)
    terms = tuple(_term(i, whole, halves, kept, rolling, needed[i]) for i in range(RIG_TERMS))
    alone = np.array([t.sigma for t in terms]) / SCALES
    return Choice(terms, final.value, np.where(kept, final.sigma, alone), kept)


def significant(
    whole: Estimate,
    halves: Sequence[Estimate],
    rolling: bool = False,
    sigmas: float | F64 = SIGMAS,
    confirmed: Bool = NONE,
    among: Bool = ALL,
) -> Bool:
    """(8,) terms that remain when the weakest insignificant one is dropped until there is none.

    Args:
        whole: estimated from all matches. halves: each from one part of them.
        sigmas: standard deviations from zero that make a term significant; one number, or (8,).
        rolling: rolling shutter; terms that motion can mimic are not written.
        confirmed: (8,) terms that the halves need not confirm.
        among: (8,) terms that may remain.
    """
    needed = np.broadcast_to(sigmas, RIG_TERMS)
    kept = among & ~ROLLING_SHUTTER_MIMICS if rolling else among.copy()
    while kept.any():
        here = whole.without(kept)
        weakest = np.argmin(np.where(kept, here.strength, np.inf))
        if here.strength[weakest] >= needed[weakest]:  # else it is dropped, whatever the halves say
            weak = kept & ((here.strength < needed) | ~(_agreed(here, halves, kept) | confirmed))
            if not weak.any():
                break
            weakest = np.argmin(np.where(weak, here.strength, np.inf))
        kept[weakest] = False
    return kept


def _agreed(here: Estimate, halves: Sequence[Estimate], kept: Bool) -> Bool:
    """(8,) values of `here`, which has the terms that are not `kept` held at zero, that every half confirms."""
    parts = np.array([half.without(kept).value for half in halves]).reshape(-1, RIG_TERMS)
    shown = parts * np.sign(here.value) >= MIN_SHARE_IN_HALVES * np.abs(here.value)
    return np.asarray(shown.all(0) if len(parts) else np.zeros(RIG_TERMS, bool))


def _term(i: int, whole: Estimate, halves: Sequence[Estimate], kept: Bool, rolling: bool, needed: float) -> Term:
    """A term that is not written is reported with the value it would have if it were the next to be written."""
    with_it = kept.copy()
    with_it[i] = True
    here, parts = whole.without(with_it), [h.without(with_it) for h in halves]
    strength = here.strength
    values = tuple(float(SCALES[i] * h.value[i]) for h in parts)
    shown = " and ".join(f"{v:+.3f}" for v in values)
    if kept[i]:
        why = f"{strength[i]:.0f} sigmas, the halves of the recording give {shown}"
    elif rolling and ROLLING_SHUTTER_MIMICS[i]:
        why = "motion with a rolling shutter can mimic it"
    elif strength[i] < needed:
        why = f"{strength[i]:.1f} sigmas, at least {needed:g} required"
    else:
        why = f"{strength[i]:.0f} sigmas, but the halves of the recording give {shown}"
    value, sigma = float(SCALES[i] * here.value[i]), float(SCALES[i] * here.sigma[i])
    return Term(NAMES[i], UNITS[i], value, sigma, values, bool(kept[i]), why)
