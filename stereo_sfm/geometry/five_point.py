"""Essential matrices from five correspondences, many samples at once.

Nister (PAMI 26, 2004) set up the problem: E in the null space of five epipolar constraints must satisfy det E = 0 and
2 E E^T E - tr(E E^T) E = 0, ten cubics in three unknowns. Solved here with the action matrix of Stewenius, Engels and
Nister (ISPRS 60, 2006). Everything works on unit bearings, so a fisheye beyond 90 degrees is the same case.
"""

from __future__ import annotations

import itertools

import numpy as np

from stereo_sfm.types import F64

# Monomials as exponents of (x, y, z), in graded reverse lexicographic order: ten of degree three come first.
_CUBIC = [
    (3, 0, 0), (2, 1, 0), (1, 2, 0), (0, 3, 0), (2, 0, 1), (1, 1, 1), (0, 2, 1), (1, 0, 2), (0, 1, 2), (0, 0, 3),
    (2, 0, 0), (1, 1, 0), (0, 2, 0), (1, 0, 1), (0, 1, 1), (0, 0, 2), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0),
]  # fmt: skip
_QUADRATIC = _CUBIC[10:]
_LINEAR = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)]


def _product_table(
    a: list[tuple[int, int, int]], b: list[tuple[int, int, int]], out: list[tuple[int, int, int]]
) -> F64:
    """(len(a) * len(b), len(out)) 0/1: which monomial the product of two monomials is."""
    table = np.zeros((len(a), len(b), len(out)))
    for (i, p), (j, q) in itertools.product(enumerate(a), enumerate(b)):
        table[i, j, out.index((p[0] + q[0], p[1] + q[1], p[2] + q[2]))] = 1.0
    return table.reshape(-1, len(out))


_LINEAR_LINEAR = _product_table(_LINEAR, _LINEAR, _QUADRATIC)
_QUADRATIC_LINEAR = _product_table(_QUADRATIC, _LINEAR, _CUBIC)


def _times(a: F64, b: F64, table: F64) -> F64:
    """Products of polynomials (..., p) x (..., q) -> (..., r) by a table of monomial products."""
    outer = a[..., :, None] * b[..., None, :]
    return outer.reshape(*outer.shape[:-2], -1) @ table


def _constraints(basis: F64) -> F64:
    """Null-space basis (B, 3, 3, 4), last axis = coefficients of x, y, z, 1 -> (B, 10, 20) cubic equations."""
    e_et = _times(basis[:, :, None, :, :], basis[:, None, :, :, :], _LINEAR_LINEAR).sum(axis=3)  # (B, 3, 3, 10)
    trace = np.einsum("biim->bm", e_et)
    lam = 2.0 * e_et
    for i in range(3):
        lam[:, i, i] -= trace
    trace_rows = _times(lam[:, :, :, None, :], basis[:, None, :, :, :], _QUADRATIC_LINEAR).sum(axis=2)  # (B, 3, 3, 20)
    det = np.zeros((len(basis), 20))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        minor = _times(basis[:, 1, j], basis[:, 2, k], _LINEAR_LINEAR) - _times(
            basis[:, 1, k], basis[:, 2, j], _LINEAR_LINEAR
        )
        det += _times(minor, basis[:, 0, i], _QUADRATIC_LINEAR)
    return np.concatenate([trace_rows.reshape(len(basis), 9, 20), det[:, None, :]], axis=1)


def _action_matrix(reduced: F64) -> F64:
    """(B, 10, 10) right half after elimination -> (B, 10, 10) multiplication by x on the ten lower monomials."""
    action = np.zeros_like(reduced)
    for row, cubic in ((0, 0), (1, 1), (2, 2), (3, 4), (4, 5), (5, 7)):
        action[:, row] = -reduced[:, cubic]
    for row, monomial in ((6, 0), (7, 1), (8, 3), (9, 6)):
        action[:, row, monomial] = 1.0
    return action


def five_point(bearings0: F64, bearings1: F64) -> F64:
    """Every real essential matrix of each sample.

    Args:
        bearings0, bearings1: (B, 5, 3) unit bearings of the same points in two cameras.

    Returns:
        (M, 3, 3) with b1^T E b0 = 0 for the five points of its sample, |E| = 1; samples whose points do not determine
        a finite set of solutions contribute none.
    """
    design = (bearings1[..., :, None] * bearings0[..., None, :]).reshape(-1, 5, 9)
    null = np.linalg.svd(design, full_matrices=True)[2][:, 5:]  # (B, 4, 9)
    basis = np.moveaxis(null.reshape(-1, 4, 3, 3), 1, -1)
    equations = _constraints(basis)
    left = equations[:, :, :10]
    usable = np.abs(np.linalg.det(left / np.linalg.norm(left, axis=2, keepdims=True).clip(1e-300))) > 1e-13
    if not usable.any():
        return np.zeros((0, 3, 3))
    basis, equations = basis[usable], equations[usable]
    reduced = np.linalg.solve(equations[:, :, :10], equations[:, :, 10:]).astype(np.float64)
    finite = np.isfinite(reduced).all(axis=(1, 2)) & (np.abs(reduced).max(axis=(1, 2)) < 1e12)
    basis, reduced = basis[finite], reduced[finite]
    if len(basis) == 0:
        return np.zeros((0, 3, 3))
    eigen = np.linalg.eig(_action_matrix(reduced))
    values, vectors = eigen.eigenvalues.astype(np.complex128), eigen.eigenvectors.astype(np.complex128)
    scale = vectors[:, 9, :]
    real = (np.abs(values.imag) < 1e-7 * (1 + np.abs(values.real))) & (np.abs(scale) > 1e-10)
    sample, root = np.nonzero(real)
    xyz = (vectors[sample, 6:9, root] / scale[sample, root][:, None]).real
    essential = np.einsum("mijk,mk->mij", basis[sample], np.concatenate([xyz, np.ones((len(xyz), 1))], axis=1))
    norm = np.linalg.norm(essential, axis=(1, 2), keepdims=True)
    return essential / norm
