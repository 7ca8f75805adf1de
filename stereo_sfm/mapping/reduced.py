"""The reduced camera system of bundle adjustment: its block pattern, and its solution, dense or sparse.

Windows are solved by a dense Cholesky factorisation. The full map is solved by a sparse LU with a minimum-degree order
of the symmetric pattern and no pivoting, which on a symmetric positive matrix does the work of a sparse Cholesky.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

from stereo_sfm.mapping import bundle_kernels
from stereo_sfm.types import F64, I64

DENSE_KEYFRAMES = 120  # above, the sparse solver is faster (benchmarks/full_ba.py)


class ReducedSystem:
    """Lower blocks of the matrix over the free keyframes that the points of one problem couple."""

    def __init__(self, starts: I64, obs_kf: I64, free: I64, dense: bool | None = None) -> None:
        """Pattern of the system.

        Args:
            starts: (P + 1,) first observation of every point. obs_kf: (M,) keyframe rows, sorted by point.
            free: (K,) row of a keyframe in the system, -1 when it is fixed.
            dense: which solver; by default by size.
        """
        self.size = int(free.max(initial=-1)) + 1
        self.dense = self.size <= DENSE_KEYFRAMES if dense is None else dense
        pairs, self.most = bundle_kernels.count_pairs(starts, obs_kf, free)
        keys = np.empty(pairs, np.int64)
        bundle_kernels.list_pairs(starts, obs_kf, free, keys)
        n = self.size
        diagonal = np.arange(n, dtype=np.int64) * (n + 1)
        if self.dense:
            self.slots = keys.astype(np.int32)
            self._rows, self._cols = np.divmod(np.arange(n * n, dtype=np.int64), max(n, 1))
            self._diagonal = diagonal
        else:
            unique, slots = np.unique(np.concatenate([diagonal, keys]), return_inverse=True)
            self.slots = slots[n:].astype(np.int32)
            self._rows, self._cols = np.divmod(unique, n)
            self._diagonal = slots[:n]

    def new_blocks(self, pose_blocks: F64) -> F64:
        """(B, 6, 6) zeros, with the (F, 6, 6) blocks of the poses on the diagonal."""
        blocks = np.zeros((len(self._rows), 6, 6))
        blocks[self._diagonal] = pose_blocks
        return blocks

    def solve(self, blocks: F64, b: F64) -> F64 | None:
        """(F, 6) step, or None where the matrix is not positive definite."""
        return self._solve_dense(blocks, b) if self.dense else self._solve_sparse(blocks, b)

    def _solve_dense(self, blocks: F64, b: F64) -> F64 | None:
        n = self.size
        matrix = blocks.reshape(n, n, 6, 6).transpose(0, 2, 1, 3).reshape(6 * n, 6 * n)
        try:
            factor = scipy.linalg.cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
        except scipy.linalg.LinAlgError:
            return None
        return scipy.linalg.cho_solve(factor, b.ravel(), check_finite=False).reshape(n, 6)

    def _solve_sparse(self, blocks: F64, b: F64) -> F64 | None:
        off = self._rows != self._cols
        rows = np.concatenate([self._rows, self._cols[off]])
        cols = np.concatenate([self._cols, self._rows[off]])
        values = np.concatenate([blocks, blocks[off].transpose(0, 2, 1)])
        order = np.lexsort((cols, rows))
        indptr = np.searchsorted(rows[order], np.arange(self.size + 1))
        shape = (6 * self.size, 6 * self.size)
        matrix = scipy.sparse.bsr_array((values[order], cols[order], indptr), shape=shape).tocsc()
        try:
            factor = scipy.sparse.linalg.splu(
                matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError:  # exactly singular
            return None
        return factor.solve(b.ravel()).reshape(self.size, 6)
