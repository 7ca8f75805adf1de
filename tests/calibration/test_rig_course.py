"""The course of terms over windows: its deviations are those that the windows' scatter shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereo_sfm.calibration.rig_course import Course, constant, steady
from stereo_sfm.calibration.rig_window import RigInformation, RigWindow
from stereo_sfm.types import F64, RIG_TERMS

STATED = 2e-4  # standard deviation that windows state
EXPECTED = np.diag(np.full(RIG_TERMS, 1e-4**2))


def windows(terms: F64, scatter: float, seed: int, alike: float = 0.0) -> list[RigWindow]:
    """One window in 10 s around terms (N, 8). `alike`: correlation of neighbours' errors."""
    rng, matrix = np.random.default_rng(seed), np.eye(RIG_TERMS) / STATED**2
    error = rng.standard_normal(RIG_TERMS)
    out: list[RigWindow] = []
    for k, own in enumerate(terms):
        error = alike * error + np.sqrt(1 - alike**2) * rng.standard_normal(RIG_TERMS)
        seen = own + scatter * error + STATED * rng.standard_normal(RIG_TERMS)
        information = RigInformation(matrix, matrix @ seen)
        out.append(RigWindow(4 * k, 4 * k + 3, k * 10**10, information, 0.1, np.zeros(RIG_TERMS), np.zeros(3)))
    return out


def deviations(courses: list[Course], column: list[float], true: F64) -> float:
    """Root mean square of the errors over their stated standard deviations."""
    found = [c.at(column) for c in courses]
    return float(np.sqrt(np.mean([((f.value - true) / f.sigma) ** 2 for f in found])))


@pytest.mark.parametrize("scatter", [0.0, STATED, 5 * STATED])
@pytest.mark.parametrize("alike", [0.0, 0.6])
def test_stated_deviations_are_those_of_the_scatter(scatter: float, alike: float) -> None:
    """Whatever windows state, and where neighbours share errors."""
    true = np.linspace(0.0, 28e-4, RIG_TERMS)
    seen = [windows(np.tile(true, (24, 1)), scatter, seed, alike) for seed in range(30)]
    assert 0.5 < deviations([constant(w, EXPECTED) for w in seen], [1.0], true) < 1.6  # without scatter: 5 and more


@pytest.mark.parametrize("scatter", [STATED, 5 * STATED])
def test_the_deviations_of_a_steady_change_are_right(scatter: float) -> None:
    true = np.linspace(0.0, 28e-4, RIG_TERMS)
    terms = np.linspace(0, 1, 24)[:, None] * true
    seen = [windows(terms, scatter, seed) for seed in range(30)]
    assert 0.5 < deviations([steady(w, w, EXPECTED) for w in seen], [0.0, 1.0], true) < 1.3
    assert 0.5 < deviations([steady(w, w, EXPECTED) for w in seen], [1.0, 0.0], true) < 1.3


def test_a_term_that_does_not_change_has_its_mean_at_the_end() -> None:
    seen = windows(np.linspace(0, 1, 24)[:, None] * np.full(RIG_TERMS, 4e-4), 0.0, 0)
    still = np.arange(RIG_TERMS) != 1
    end = steady(seen, seen, EXPECTED).with_zero(1, still).at([1.0, 0.0])
    assert end.value == pytest.approx(np.where(still, 2e-4, 4e-4), abs=2e-4)
    assert (end.sigma[1] > end.sigma[still]).all()


def test_what_a_turn_adds_is_not_a_term() -> None:
    """What only windows show that turn is not known to be one of the rig until windows turn otherwise."""
    straight = windows(np.tile(1e-3 * np.eye(RIG_TERMS)[1], (12, 1)), 0.0, 0)
    turning = [replace(w, turn=np.array([0.0, 0.4, 0.0])) for w in straight]
    alone, together = (constant(w, EXPECTED).at([1.0]) for w in (straight, turning))
    assert alone.strength[1] > 4 > 2 > together.strength[1]
