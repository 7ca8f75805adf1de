"""Compiled order statistics have numpy's bits."""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry.order_statistics import median, median_distance, percentile


def test_medians_are_numpys_with_and_without_ties() -> None:
    rng = np.random.default_rng(0)
    for n in range(1, 60):
        for values in (
            rng.normal(size=n),
            rng.integers(0, 4, n).astype(float),
            np.ones(n),
            np.sort(rng.normal(size=n)),
        ):
            before = values.copy()
            assert median(values) == np.median(values)
            assert (values == before).all()


def test_a_median_of_values_that_are_no_numbers_ends() -> None:
    median(np.full(9, np.nan))
    median(np.array([np.nan, 1.0, np.inf, 0.0]))


def test_the_median_distance_counts_the_chosen_points() -> None:
    a, b = np.zeros((4, 2)), np.array([[3.0, 4.0], [1.0, 0.0], [0.0, 2.0], [9.0, 9.0]])
    assert median_distance(a, b, np.array([True, True, True, False])) == 2.0
    assert median_distance(a, b, np.zeros(4, bool)) == np.inf


def test_percentiles_are_numpys() -> None:
    values = np.random.default_rng(1).normal(size=37)
    assert np.isclose(percentile(values, 25), np.percentile(values, 25), rtol=1e-15)
