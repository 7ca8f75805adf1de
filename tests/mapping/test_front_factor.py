"""Nested dissection and the factorisation by fronts against dense algebra, on graphs with loops."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from stereo_sfm.mapping.front_factor import FrontFactor, FrontPattern
from stereo_sfm.mapping.nested_dissection import LEAF, fronts_of
from stereo_sfm.types import F64, I64, Bool

Blocks = tuple[I64, I64, F64]  # rows (B,), cols (B,), (B, 6, 6)


def aisles(count: int, length: int, reach: int, rng: np.random.Generator) -> Bool:
    """(n, n) which keyframes see the same points: parallel aisles, each joined to the next at one end, some loops, and
    a keyframe apart.
    """
    n = count * length
    at = np.arange(n)
    near = (np.abs(at[:, None] - at) <= reach) & (at[:, None] // length == at // length)
    head = at % length < reach
    near |= head[:, None] & head & (np.abs(at[:, None] // length - at // length) <= 1)
    a, b = rng.integers(0, n, (2, 5))
    near[a, b] = near[b, a] = True
    near[-1, :-1] = near[:-1, -1] = False
    return near


def system(near: Bool, rng: np.random.Generator) -> tuple[F64, Blocks]:
    """A positive definite matrix with that pattern, and one block of each symmetric pair, in any triangle."""
    n = len(near)
    values = rng.normal(size=(n, n, 6, 6)) * near[:, :, None, None]
    matrix = values.transpose(0, 2, 1, 3).reshape(6 * n, 6 * n)
    matrix = matrix + matrix.T
    matrix += np.diag(np.abs(matrix).sum(1) + 0.1)
    rows, cols = np.nonzero(np.tril(near))
    swap = rng.random(len(rows)) < 0.5
    rows, cols = np.where(swap, cols, rows), np.where(swap, rows, cols)
    blocks = matrix.reshape(n, 6, n, 6).transpose(0, 2, 1, 3)[rows, cols]
    return matrix, (rows, cols, np.ascontiguousarray(blocks))


@pytest.mark.parametrize(("count", "length", "reach"), [(1, 30, 3), (1, 200, 6), (6, 60, 4), (3, 90, 12)])
def test_the_solution_is_that_of_dense_algebra(count: int, length: int, reach: int) -> None:
    rng = np.random.default_rng([count, length])
    near = aisles(count, length, reach, rng)
    matrix, (rows, cols, blocks) = system(near, rng)
    factor = FrontFactor.of(FrontPattern(fronts_of(scipy.sparse.csr_array(near)), rows, cols), blocks)
    assert factor is not None
    b = rng.normal(size=(len(near), 6))
    np.testing.assert_allclose(factor.solve(b).ravel(), np.linalg.solve(matrix, b.ravel()), atol=1e-10)


def test_a_matrix_that_is_not_positive_definite_has_no_factor() -> None:
    rng = np.random.default_rng(0)
    near = aisles(4, 40, 4, rng)
    _, (rows, cols, blocks) = system(near, rng)
    pattern = FrontPattern(fronts_of(scipy.sparse.csr_array(near)), rows, cols)
    blocks[(rows == 77) & (cols == 77)] *= -1.0
    assert FrontFactor.of(pattern, blocks) is None


def test_every_keyframe_is_eliminated_once_and_parts_do_not_touch() -> None:
    near = aisles(8, 70, 5, np.random.default_rng(1))
    fronts = fronts_of(scipy.sparse.csr_array(near))
    order = np.concatenate([front.own for front in fronts])
    assert np.array_equal(np.sort(order), np.arange(len(near)))
    place = np.argsort(order)
    part = np.repeat(np.arange(len(fronts)), [len(front.own) for front in fronts])[place]
    for k, front in enumerate(fronts):
        later = np.flatnonzero(near[front.own].any(0) & (part > k))
        assert np.isin(later, front.others).all() and (part[front.others] > k).all()
        assert front.parent == (part[front.others].min() if len(front.others) else -1)
    assert len(fronts) > 8 and max(len(front.own) for front in fronts) <= 2 * LEAF


def test_the_work_grows_as_the_store() -> None:
    """Twice as many aisles, about twice the multiplications."""

    def work(count: int) -> float:
        fronts = fronts_of(scipy.sparse.csr_array(aisles(count, 60, 4, np.random.default_rng(2))))
        return sum(len(f.own) * (len(f.own) + len(f.others)) ** 2 for f in fronts)

    assert work(16) < 2.5 * work(8)
