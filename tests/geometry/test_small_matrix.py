"""Small symmetric systems against LAPACK."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.geometry.small_matrix import invert_symmetric, solve_symmetric


@pytest.mark.parametrize("size", [1, 3, 6])
def test_solves_and_inverts_as_lapack_does(size: int) -> None:
    rng = np.random.default_rng(size)
    for _ in range(50):
        half = rng.normal(size=(size, size + 2))
        a, b = half @ half.T + 0.01 * np.eye(size), rng.normal(size=size)
        x, inverse, factor = np.zeros(size), np.zeros((size, size)), np.zeros((size, size))
        assert solve_symmetric(a, b, x, factor)
        assert invert_symmetric(a, inverse, factor)
        np.testing.assert_allclose(x, np.linalg.solve(a, b), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(inverse, np.linalg.inv(a), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("a", [np.zeros((3, 3)), -np.eye(3), np.ones((3, 3)), np.full((3, 3), np.nan)])
def test_an_indefinite_matrix_is_reported(a: np.ndarray) -> None:
    x, inverse = np.full(3, 7.0), np.full((3, 3), 7.0)
    assert not solve_symmetric(a, np.ones(3), x, np.zeros((3, 3)))
    assert not invert_symmetric(a, inverse, np.zeros((3, 3)))
    assert (x == 7.0).all()
    assert (inverse == 7.0).all()
