"""Which terms of a correction are written: significant ones that both halves confirm."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.calib.choice import Estimate, choose
from stereo_sfm.calib.consequences import consequences
from stereo_sfm.calib.consistency import estimate
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.types import RIG_TERMS
from tests.calib.test_check import RIGS, SEEN, magnified, turned, windows
from tests.synthetic import pinhole_rig

SIGMA = np.array([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4])


def estimated(*values: float) -> Estimate:
    value = np.array([*values, *[0.0] * (RIG_TERMS - len(values))])
    return Estimate(SIGMA * value, np.diag(SIGMA**2))


def test_a_term_needs_several_sigmas_and_both_halves() -> None:
    halves = estimated(8, 3, 8, 0, 0, -9), estimated(12, 3, -1, 0, 0, -6)
    choice = choose(estimated(10, 3, 9, 0, 0, -7), halves)
    assert choice.selected.tolist() == [True, False, False, False, False, True, False, False]
    assert "10 sigmas" in choice.terms[0].why and "at least 4 required" in choice.terms[1].why
    assert "but the halves" in choice.terms[2].why
    assert choice.value[1] == choice.value[2] == 0.0


def test_a_term_confirmed_before_needs_no_halves() -> None:
    halves = estimated(-1, 5), estimated(9, 5)
    confirmed = np.arange(RIG_TERMS) == 0
    choice = choose(estimated(4, 5), halves, sigmas=np.where(confirmed, 1.0, 5.0), confirmed=confirmed)
    assert choice.selected[:2].tolist() == [True, True]
    assert not choose(estimated(4, 5), halves, sigmas=np.where(confirmed, 1.0, 5.0)).selected[0]


def test_without_a_second_half_nothing_is_written_and_the_rig_is_the_same() -> None:
    choice = choose(estimated(10, 10, 10, 10, 10, 10), ())
    assert not choice.selected.any()
    assert choice.apply(RIGS["pinhole"]) is RIGS["pinhole"]


def test_no_term_is_stronger_than_the_estimate_reaches() -> None:
    rng = np.random.default_rng(0)
    for kept in rng.integers(0, 2, (50, RIG_TERMS)).astype(bool):
        root = rng.normal(size=(RIG_TERMS, RIG_TERMS))
        whole = Estimate(rng.normal(size=RIG_TERMS), root @ root.T)
        assert whole.without(kept | (np.arange(RIG_TERMS) == 0)).strength.max() <= whole.reach * (1 + 1e-9)
    assert estimated(3, 4).reach == pytest.approx(5)
    assert Estimate(np.zeros(RIG_TERMS), np.zeros((RIG_TERMS, RIG_TERMS))).reach == 0


def test_terms_that_trade_with_one_that_stays_take_its_part() -> None:
    """A rotation about x and the baseline's z are correlated: uncertain together, significant alone."""
    covariance = np.diag(SIGMA**2)
    a, b = 0, 4
    covariance[a, a], covariance[b, b] = 25 * SIGMA[a] ** 2, 25 * SIGMA[b] ** 2
    covariance[a, b] = covariance[b, a] = 24.5 * SIGMA[a] * SIGMA[b]
    value = np.zeros(RIG_TERMS)
    value[a], value[b] = 12 * SIGMA[a], 3 * SIGMA[b]
    both = Estimate(value, covariance)
    choice = choose(both, (both, both))
    assert choice.selected[a] and not choice.selected[b]
    assert choice.value[a] == pytest.approx(value[a] - 24.5 / 25 * 3 * SIGMA[a])


@pytest.mark.parametrize("name", RIGS)
def test_a_true_rig_is_left_to_the_bit(name: str) -> None:
    correction = estimate(RIGS[name], SEEN[name])
    assert choose(correction.whole, correction.halves).apply(RIGS[name]) is RIGS[name]


def test_only_the_faulty_term_is_written_and_the_common_focal_length_never() -> None:
    wrong = turned(magnified(RIGS["pinhole"], 0.98, 0.98), (0.0, 0.2, 0.0))
    correction = estimate(wrong, SEEN["pinhole"])
    choice = choose(correction.whole, correction.halves)
    assert choice.selected[1] and not choice.selected[0] and not choice.selected[2]
    mended = choice.apply(wrong)
    assert mended.left.fx == wrong.left.fx and mended.baseline == pytest.approx(wrong.baseline, rel=1e-12)


def test_a_rolling_shutter_may_pretend_what_motion_shows() -> None:
    choice = choose(estimated(10, 10, 10, 10, 10, 10), (estimated(10, 10, 10, 10, 10, 10),) * 2, rolling=True)
    assert choice.selected.tolist() == [True, False, True, False, False, True, False, False]


def test_consequences_of_a_disparity_error() -> None:
    """Pinhole, fx b = 40 px m: one pixel at 2 m (disparity 20 px) is 5 %, at 20 m (2 px) it is half or double."""
    rig = pinhole_rig()
    angle = 1.0 / rig.left.fx
    true = Rig(rig.left, rig.right, rig.left_T_right @ se3.exp(np.array([0, 0, 0, 0, angle, 0])))
    found = consequences(rig, true, windows(true))
    assert abs(found.disparity_px) == pytest.approx(1.0, rel=0.1)
    sign = -np.sign(found.disparity_px)
    expected = [1 / (1 - sign * d) - 1 for d in (2 / 40, 5 / 40, 20 / 40)]
    np.testing.assert_allclose(found.depth, expected, rtol=0.2)
    assert np.sign(found.length) == sign and 0.02 < abs(found.length) < 0.3
