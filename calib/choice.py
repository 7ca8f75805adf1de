"""Which terms of a correction have the evidence to be written into a calibration: those beyond several of their own
standard deviations that both halves of the recording show, each on its own. What is left out stays as it is, and the
others take the values that they have when it does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.scene_model import DIRECTION, FOCAL_RIGHT, ROTATION, SHARED, moved
from stereo_sfm.types import F64, Bool

TERMS = 6  # turn of the right camera (3), direction of the baseline (2), focal length of the right against the left
NAMES = (
    *(f"rotation of the right camera about {axis}" for axis in "xyz"),
    *(f"baseline direction, {axis}" for axis in "yz"),
    "focal length, right against left",
)
UNITS = (*["degrees"] * 5, "%")
SCALES = np.array([*[np.rad2deg(1.0)] * 5, 100.0])  # to those units
NOT_BY_ROWS = np.array([False, True, False, True, True, False])  # what a rolling shutter's motion may pretend
SIGMAS = 4.0  # of its own that a term must be away from zero
SHARE = 0.5  # of its value that either half must show, with the same sign


def with_terms(rig: Rig, value: F64) -> Rig:
    """The rig with the terms (6,) added; the very same when they are zero."""
    if not value.any():
        return rig
    vector = np.zeros(SHARED)
    vector[ROTATION], vector[DIRECTION], vector[FOCAL_RIGHT] = value[:3], value[3:5], value[5]
    return moved(rig, vector)


@dataclass(frozen=True, eq=False)
class Estimate:
    """The terms as one set of matches shows them."""

    value: F64  # (6,) radians and, of the focal length, ratio
    covariance: F64  # (6, 6)

    def without(self, kept: Bool) -> Estimate:
        """The same with the terms that are not `kept` (6,) held at zero: the Gaussian's conditional."""
        value, covariance = np.zeros(TERMS), np.zeros((TERMS, TERMS))
        inside, across = np.ix_(kept, kept), np.ix_(kept, ~kept)
        gain = self.covariance[across] @ np.linalg.pinv(self.covariance[np.ix_(~kept, ~kept)])
        value[kept] = self.value[kept] - gain @ self.value[~kept]
        covariance[inside] = self.covariance[inside] - gain @ self.covariance[across].T
        return Estimate(value, covariance)

    @property
    def sigma(self) -> F64:
        """(6,) standard deviations."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


@dataclass(frozen=True)
class Term:
    """One term, whether it is written, and why; numbers in `unit`."""

    name: str
    unit: str
    value: float
    sigma: float
    halves: tuple[float, ...]
    written: bool
    why: str

    @property
    def line(self) -> str:
        """For people."""
        what = f"{self.value:+.3f} +- {self.sigma:.3f} {self.unit}"
        return f"{self.name}: {'written' if self.written else 'left as it is'}, {what} ({self.why})"


@dataclass(frozen=True, eq=False)
class Choice:
    """What may be written."""

    terms: tuple[Term, ...]
    value: F64  # (6,) zero where nothing is written
    sigma: F64  # (6,) of what is written; of the rest, how well it is known
    written: Bool  # (6,)

    def apply(self, rig: Rig) -> Rig:
        """The corrected rig; the very same when nothing is written."""
        return with_terms(rig, self.value)


def choose(whole: Estimate, halves: Sequence[Estimate], rolling: bool = False, sigmas: float | F64 = SIGMAS) -> Choice:
    """Drop the weakest term that lacks evidence until all that are left have it.

    Args:
        whole: of all matches. halves: each of its own part of them.
        sigmas: of its own that a term must be away from zero; one number, or (6,).
        rolling: rows are exposed one after the other, and what only motion shows is not to be believed.
    """
    needed = np.broadcast_to(sigmas, TERMS)
    kept = ~NOT_BY_ROWS if rolling else np.ones(TERMS, bool)
    while kept.any():
        strength, agreed = _evidence(whole, halves, kept)
        weak = kept & ((strength < needed) | ~agreed)
        if not weak.any():
            break
        kept[np.argmin(np.where(weak, strength, np.inf))] = False
    final = whole.without(kept)
    terms = tuple(_term(i, whole, halves, kept, rolling, needed[i]) for i in range(TERMS))
    alone = np.array([t.sigma for t in terms]) / SCALES
    return Choice(terms, final.value, np.where(kept, final.sigma, alone), kept)


def _evidence(whole: Estimate, halves: Sequence[Estimate], kept: Bool) -> tuple[F64, Bool]:
    """(6,) values in their own standard deviations, and (6,) whether every half shows them too."""
    here = whole.without(kept)
    parts = np.array([half.without(kept).value for half in halves]).reshape(-1, TERMS)
    strength = np.abs(here.value) / np.maximum(here.sigma, 1e-12)
    shown = parts * np.sign(here.value) >= SHARE * np.abs(here.value)
    return strength, np.asarray(shown.all(0) if len(parts) else np.zeros(TERMS, bool))


def _term(i: int, whole: Estimate, halves: Sequence[Estimate], kept: Bool, rolling: bool, needed: float) -> Term:
    """A term that is left out is shown as it would be if it were the next to be written."""
    with_it = kept.copy()
    with_it[i] = True
    strength, _ = _evidence(whole, halves, with_it)
    here, parts = whole.without(with_it), [h.without(with_it) for h in halves]
    values = tuple(float(SCALES[i] * h.value[i]) for h in parts)
    said = " and ".join(f"{v:+.3f}" for v in values)
    if kept[i]:
        why = f"{strength[i]:.0f} sigmas, the halves of the recording say {said}"
    elif rolling and NOT_BY_ROWS[i]:
        why = "with a rolling shutter motion may pretend it"
    elif strength[i] < needed:
        why = f"{strength[i]:.1f} sigmas, {needed:g} are needed"
    else:
        why = f"{strength[i]:.0f} sigmas, but the halves of the recording say {said}"
    value, sigma = float(SCALES[i] * here.value[i]), float(SCALES[i] * here.sigma[i])
    return Term(NAMES[i], UNITS[i], value, sigma, values, bool(kept[i]), why)
