"""The direction of walls in a plan."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.geometry.dominant_direction import dominant_direction


@pytest.mark.parametrize("degrees", [-30.0, -3.0, 0.0, 12.0, 40.0])
def test_it_finds_the_angle(degrees: float) -> None:
    rng = np.random.default_rng(0)
    walls = np.concatenate([np.stack([rng.uniform(0, 10, 500), np.full(500, y)], 1) for y in (0.0, 2.0, 4.5)])
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    turned = walls @ np.array([[c, s], [-s, c]]) + rng.normal(0, 0.01, walls.shape)
    assert np.rad2deg(dominant_direction(turned)) == pytest.approx(degrees, abs=0.5)


def test_uncertain_points_count_less() -> None:
    rng = np.random.default_rng(1)
    wall = np.stack([rng.uniform(0, 6, 300), rng.normal(1.0, 0.01, 300)], 1)
    clutter = rng.uniform(0, 6, (600, 2))
    weights = np.repeat([1.0, 0.01], [300, 600])
    assert abs(np.rad2deg(dominant_direction(np.concatenate([wall, clutter]), weights))) < 0.5


def test_too_few_points_say_nothing() -> None:
    assert dominant_direction(np.zeros((3, 2))) == 0.0
