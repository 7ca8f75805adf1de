"""Cholesky factorisation of a matrix of 6x6 blocks, front by front, and its solution."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf, dtrtrs

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.mapping.nested_dissection import Front
from stereo_sfm.types import F64, I64, Bool


@dataclass(frozen=True, eq=False)
class _Blocks:
    """The blocks of the matrix that begin in one front: their numbers, and where in the front they lie."""

    number: I64  # (B,)
    row: I64  # (B,) at or behind `col`
    col: I64  # (B,) among the front's own nodes
    transposed: Bool  # (B,) a block belongs to (col, row)


class FrontPattern:
    """Where the blocks of a symmetric matrix, given by its lower or upper ones, lie in the fronts."""

    def __init__(self, fronts: Sequence[Front], rows: I64, cols: I64) -> None:
        """rows, cols: (B,) nodes of each block, each pair once."""
        self.fronts = fronts
        size = sum(len(front.own) for front in fronts)
        place, part_of = np.empty(size, np.int64), np.empty(size, np.int64)
        order = np.concatenate([np.zeros(0, np.int64), *(front.own for front in fronts)])
        place[order] = np.arange(size)
        for k, front in enumerate(fronts):
            part_of[front.own] = k
        transposed = place[rows] < place[cols]
        late, early = np.where(transposed, cols, rows), np.where(transposed, rows, cols)
        by_front = np.argsort(part_of[early], kind="stable")
        bounds = np.searchsorted(part_of[early][by_front], np.arange(len(fronts) + 1))
        self.blocks: list[_Blocks] = []
        self.at_parent: list[I64] = []  # where in the parent each front's others lie
        for k, front in enumerate(fronts):
            number = by_front[bounds[k] : bounds[k + 1]]
            row, col = (_within(front, place, nodes[number]) for nodes in (late, early))
            self.blocks.append(_Blocks(number, row, col, transposed[number]))
            none = np.zeros(0, np.int64)
            self.at_parent.append(none if front.parent < 0 else _within(fronts[front.parent], place, front.others))


def _within(front: Front, place: I64, nodes: I64) -> I64:
    """(N,) numbers of nodes in a front: its own, then the others."""
    return np.searchsorted(np.append(place[front.own], place[front.others]), place[nodes])


@dataclass(frozen=True, eq=False)
class FrontFactor:
    """The factor of every front: L, lower, of its own nodes, and the rows of the others."""

    pattern: FrontPattern
    own: list[F64]  # (6 S, 6 S)
    others: list[F64]  # (6 T, 6 S)

    @staticmethod
    def of(pattern: FrontPattern, blocks: F64) -> FrontFactor | None:
        """Factorise blocks (B, 6, 6); None where the matrix is not positive definite.

        Arrays hold the columns of a front as rows, so that LAPACK reads their transposes as they are.
        """
        factor = FrontFactor(pattern, [], [])
        handed_on: list[list[tuple[F64, I64]]] = [[] for _ in pattern.fronts]
        for k, front in enumerate(pattern.fronts):
            s, t = 6 * len(front.own), 6 * len(front.others)
            own, others, rest = np.zeros((s, s)), np.zeros((s, t)), np.zeros((t, t))
            of = pattern.blocks[k]
            _fill(blocks, of.number, of.row, of.col, of.transposed, own, others)
            for left, at in handed_on[k]:
                _add(left, at, own, others, rest)
            handed_on[k].clear()
            lower, failed = dpotrf(own.T, lower=1, overwrite_a=1)
            if failed:
                return None
            below = others.T
            if t:
                below = dtrsm(1.0, lower, below, side=1, lower=1, trans_a=1, overwrite_b=1)
                left = dsyrk(-1.0, below, beta=1.0, c=rest.T, lower=1, overwrite_c=1)
                handed_on[front.parent].append((left.T, pattern.at_parent[k]))
            factor.own.append(lower)
            factor.others.append(below)
        return factor

    def solve(self, b: F64) -> F64:
        """x (n, 6) of A x = b (n, 6)."""
        x = b.copy()
        for k, front in enumerate(self.pattern.fronts):
            y, _ = dtrtrs(self.own[k], x[front.own].ravel(), lower=1)
            x[front.own] = y.reshape(-1, 6)
            x[front.others] -= (self.others[k] @ y).reshape(-1, 6)
        for k in range(len(self.own) - 1, -1, -1):
            front = self.pattern.fronts[k]
            y = x[front.own].ravel() - self.others[k].T @ x[front.others].ravel()
            x[front.own] = dtrtrs(self.own[k], y, lower=1, trans=1)[0].reshape(-1, 6)
        return x


@njit
def _fill(blocks, number, row, col, transposed, own, others):
    """Blocks into the columns of a front: (6 S, 6 S) of its own nodes, and (6 S, 6 T) of the others' rows."""
    size = own.shape[0] // 6
    for n in range(number.shape[0]):
        block = blocks[number[n]]
        for j in range(6):
            column = own[6 * col[n] + j] if row[n] < size else others[6 * col[n] + j]
            first = 6 * row[n] if row[n] < size else 6 * (row[n] - size)
            for i in range(6):
                column[first + i] = block[j, i] if transposed[n] else block[i, j]


@njit
def _add(left, at, own, others, rest):
    """Add what is left of a front, lower columns (6 U, 6 U), to its parent, where its nodes are those `at` (U,)."""
    size = own.shape[0] // 6
    for q in range(at.shape[0]):
        for j in range(6):
            source = left[6 * q + j]
            for p in range(q, at.shape[0]):
                if at[q] >= size:
                    target, first = rest[6 * (at[q] - size) + j], 6 * (at[p] - size)
                elif at[p] >= size:
                    target, first = others[6 * at[q] + j], 6 * (at[p] - size)
                else:
                    target, first = own[6 * at[q] + j], 6 * at[p]
                for i in range(6):
                    target[first + i] += source[6 * p + i]
