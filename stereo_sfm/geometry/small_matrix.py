"""Compiled algebra of small symmetric positive definite matrices, in plain loops.

LAPACK inside a compiled kernel costs seconds of compilation, has overhead at this size, and its results differ in the
last bits between processors; these loops avoid all three.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportUnknownVariableType=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.kernels import inner, njit


@inner
def cholesky(a, factor):
    """Lower triangular `factor` (n, n) with factor @ factor.T = a; False where `a` is not positive definite."""
    n = a.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    return True


@inner
def cholesky_solve(factor, b, x):
    """x (n,) with a @ x = b, given `cholesky` of a."""
    n = factor.shape[0]
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= factor[i, k] * x[k]
        x[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * x[k]
        x[i] = total / factor[i, i]


@njit
def solve_symmetric(a, b, x, factor):
    """x (n,) with a @ x = b for positive definite a (n, n); False, and x untouched, where it is not.

    `factor` (n, n) is scratch.
    """
    if not cholesky(a, factor):
        return False
    cholesky_solve(factor, b, x)
    return True


@njit
def invert_symmetric(a, inverse, factor):
    """inverse (n, n) of positive definite a; False, and `inverse` untouched, where it is not. `factor` is scratch."""
    n = a.shape[0]
    if not cholesky(a, factor):
        return False
    unit, column = np.zeros(n), np.zeros(n)
    for c in range(n):
        unit[c] = 1.0
        cholesky_solve(factor, unit, column)
        unit[c] = 0.0
        for r in range(n):
            inverse[r, c] = column[r]
    return True
