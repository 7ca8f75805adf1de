"""The reduced camera system of bundle adjustment: its block pattern, and its solution, dense or sparse.

Windows are solved by a dense Cholesky factorisation, the full map by SuperLU in the order of the minimum degree.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from scipy.linalg.lapack import dposv  # pyright: ignore[reportAttributeAccessIssue, reportUnknownVariableType]
from scipy.sparse.linalg import splu

from stereo_sfm.mapping import bundle_kernels
from stereo_sfm.types import F64, I32, I64

DENSE_KEYFRAMES = 300  # above, the sparse factorisation is faster (benchmarks/full_ba.py --solvers)


class ReducedSystem:
    """Lower blocks of the matrix over the free keyframes that the points of one problem couple."""

    def __init__(self, starts: I64, obs_kf: I64, free: I64, dense: bool | None = None) -> None:
        """Pattern of the system.

        Args:
            starts: (P + 1,) first observation of every point. obs_kf: (M,) keyframe rows, sorted by point.
            free: (K,) row of a keyframe in the system, -1 when it is fixed.
            dense: which solver; by default by size.
        """
        self.size = n = int(free.max(initial=-1)) + 1
        self.dense = n <= DENSE_KEYFRAMES if dense is None else dense
        seen = np.diff(np.append(0, np.cumsum(free[obs_kf] >= 0))[starts])  # (P,) free keyframes of every point
        self.most, keys = int(seen.max(initial=0)), np.empty(int((seen * (seen + 1) // 2).sum()), np.int64)
        bundle_kernels.list_pairs(starts, obs_kf, free, n, keys)
        self.slots: I32  # block of every pair, in that order
        diagonal = np.arange(n, dtype=np.int64) * (n + 1)
        if self.dense:
            self.count, self.slots, self._diagonal = n * n, keys.astype(np.int32), diagonal
            return
        unique, slots = np.unique(np.concatenate([diagonal, keys]), return_inverse=True)
        self.count, self.slots, self._diagonal = len(unique), slots[n:].astype(np.int32), slots[:n]
        rows, cols = np.divmod(unique, n)
        self._lower = np.flatnonzero(rows != cols)  # blocks that stand above the diagonal, too, transposed
        columns, rows = np.append(cols, rows[self._lower]), np.append(rows, cols[self._lower])
        self._order = np.lexsort((rows, columns))
        self._rows, self._starts = rows[self._order], np.searchsorted(columns[self._order], np.arange(n + 1))

    def new_blocks(self, pose_blocks: F64) -> F64:
        """(B, 6, 6) zeros, with the (F, 6, 6) blocks of the poses on the diagonal."""
        blocks = np.zeros((self.count, 6, 6))
        blocks[self._diagonal] = pose_blocks
        return blocks

    def solve(self, blocks: F64, b: F64) -> F64 | None:
        """(F, 6) step; None where the dense matrix is not positive definite, or the sparse one singular."""
        n = self.size
        if self.dense:
            columns = blocks.reshape(n, n, 6, 6).transpose(1, 3, 0, 2).reshape(6 * n, 6 * n)  # as LAPACK has them
            _, step, failed = dposv(columns.T, b.ravel(), lower=1, overwrite_a=1)
            return None if failed else step.reshape(n, 6)
        both = np.concatenate([blocks, blocks[self._lower].mT])[self._order].mT  # of the transpose, by rows
        matrix = scipy.sparse.bsr_array((both, self._rows, self._starts), shape=(6 * n, 6 * n)).tocsr().T
        try:  # without pivots, which a positive definite matrix does not need
            factor = splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError:  # singular
            return None
        return factor.solve(b.ravel()).reshape(-1, 6)
