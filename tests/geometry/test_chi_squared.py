"""Quantiles of chi-squared against scipy's."""

from __future__ import annotations

import pytest
from scipy.special import chdtri

from stereo_sfm.geometry.chi_squared import chi_squared


@pytest.mark.parametrize("freedoms", [1, 2, 3, 6, 9, 20])
@pytest.mark.parametrize("probability", [0.05, 0.5, 0.95, 0.99, 0.999])
def test_quantiles_are_those_of_scipy(probability: float, freedoms: int) -> None:
    assert chi_squared(freedoms, probability) == pytest.approx(chdtri(freedoms, 1 - probability), abs=6e-4)
