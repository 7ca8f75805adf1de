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
    found = [
        steady_change(w, w, np.zeros(RIG_TERMS), SYSTEMATIC)[1] for w in (windows(true, scatter, s) for s in range(40))
    ]
    errors = np.array([(f.value - true) / f.sigma for f in found])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=0.15)


def test_the_end_has_an_error_that_no_scatter_shows() -> None:
    seen = windows(np.full(RIG_TERMS, 4e-4), 0.1 * STATED, 0)
    end, change = steady_change(seen, seen, np.full(RIG_TERMS, 1e-4), SYSTEMATIC)
    assert end.value == pytest.approx(np.full(RIG_TERMS, 3e-4), abs=5e-5)
    assert (end.sigma > SYSTEMATIC).all() and (change.sigma < 0.5 * SYSTEMATIC).all()
