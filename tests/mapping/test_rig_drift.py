"""The steady change of terms: its errors are those that the windows' scatter shows."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.mapping.rig_drift import steady_change
from stereo_sfm.mapping.rig_window import RigInformation, RigWindow
from stereo_sfm.types import F64, RIG_TERMS

STATED = 2e-4  # standard deviation that windows state
SYSTEMATIC = np.full(RIG_TERMS, 1e-4)


def windows(change: F64, scatter: float, seed: int, count: int = 24) -> list[RigWindow]:
    """One window in 10 s; terms change from zero by `change` over all."""
    rng, matrix = np.random.default_rng(seed), np.eye(RIG_TERMS) / STATED**2
    terms = [k / (count - 1) * change + scatter * rng.standard_normal(RIG_TERMS) for k in range(count)]
    informations = [RigInformation(matrix, matrix @ t) for t in terms]
    return [
        RigWindow(4 * k, 4 * k + 3, k * 10**10, information, 0.1, np.zeros(RIG_TERMS))
        for k, information in enumerate(informations)
    ]


@pytest.mark.parametrize("scatter", [0.2 * STATED, STATED, 3 * STATED])
def test_sigmas_of_the_change_are_right_whatever_windows_state(scatter: float) -> None:
    true = 4e-4 * np.arange(RIG_TERMS)
    seen = [windows(true, scatter, seed) for seed in range(40)]
    found = [steady_change(w, w, np.zeros(RIG_TERMS), SYSTEMATIC).estimate for w in seen]
    errors = np.array([(f.value - true) / f.sigma for f in found])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=0.15)


def test_a_term_that_does_not_change_has_its_mean_at_the_end() -> None:
    """More exact than the end of a line; no term is more exact than an error that all windows share."""
    seen = windows(np.full(RIG_TERMS, 4e-4), 0.1 * STATED, 0)
    fit = steady_change(seen, seen, np.full(RIG_TERMS, 1e-4), SYSTEMATIC)
    end = fit.at_the_end(np.arange(RIG_TERMS) == 1)
    assert end.value == pytest.approx(np.where(np.arange(RIG_TERMS) == 1, 3e-4, 1e-4), abs=3e-5)
    assert (end.sigma > SYSTEMATIC).all() and (end.sigma[1] > np.delete(end.sigma, 1)).all()
