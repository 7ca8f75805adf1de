"""Bounds of squared, normalised errors."""

from __future__ import annotations

import functools
import math


@functools.cache
def chi_squared(freedoms: int, probability: float = 0.99) -> float:
    """What a chi-squared variable exceeds with 1 - probability, to three decimals: more differ between C libraries.

    By bisection of the upper tail (Abramowitz and Stegun, Handbook of Mathematical Functions, 26.4.4 and 26.4.5).
    """
    low, high = 0.0, 1000.0
    while low < (x := 0.5 * (low + high)) < high:
        tail = math.erfc(math.sqrt(x / 2)) if freedoms % 2 else math.exp(-x / 2)
        for k in range(2 - freedoms % 2, freedoms, 2):
            tail += (x / 2) ** (k / 2) * math.exp(-x / 2) / math.gamma(k / 2 + 1)
        low, high = (x, high) if tail > 1 - probability else (low, x)
    return round(low, 3)
