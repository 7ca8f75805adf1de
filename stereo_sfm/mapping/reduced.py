"""The reduced camera system of bundle adjustment: its block pattern, and its solution, dense or banded.

Windows are solved by a dense Cholesky factorisation. The full map is reordered by reverse Cuthill-McKee, which gathers
the keyframes that see the same points, loops included, into a band, and solved by LAPACK's band Cholesky; one step
on 1,000 keyframes takes 0.6 s there, 3 to 4 s in scipy's sparse LU, and never more than the dense factorisation.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv  # pyright: ignore[reportAttributeAccessIssue, reportUnknownVariableType]

from stereo_sfm.mapping import bundle_kernels
from stereo_sfm.types import F64, I64

DENSE_KEYFRAMES = 200  # above, the banded solver is faster (benchmarks/full_ba.py --solvers)


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
        pairs, self.most = bundle_kernels.count_pairs(starts, obs_kf, free)
        keys = np.empty(pairs, np.int64)
        bundle_kernels.list_pairs(starts, obs_kf, free, keys)
        diagonal = np.arange(n, dtype=np.int64) * (n + 1)
        if self.dense:
            self.count, self._slots, self._diagonal = n * n, keys.astype(np.int32), diagonal
            return
        unique, slots = np.unique(np.concatenate([diagonal, keys]), return_inverse=True)
        self.count, self._slots, self._diagonal = len(unique), slots[n:].astype(np.int32), slots[:n]
        self._set_band(*np.divmod(unique, n))

    @property
    def slots(self) -> NDArray[np.int32]:
        """Block of every pair in the order of bundle_kernels.list_pairs."""
        return self._slots

    def _set_band(self, rows: I64, cols: I64) -> None:
        """Reorder so that coupled keyframes are near each other; where every entry of a block lies in the band."""
        n = self.size
        ones = np.ones(len(rows), np.int8)
        graph = scipy.sparse.csr_array((ones, (rows, cols)), shape=(n, n))
        order = scipy.sparse.csgraph.reverse_cuthill_mckee(scipy.sparse.csr_array(graph + graph.T), True)
        place = np.empty(n, np.int64)
        place[order] = np.arange(n)
        self._place = place
        self._swap = place[rows] < place[cols]  # the block falls into the upper triangle: its transpose is stored
        self._high, self._low = np.maximum(place[rows], place[cols]), np.minimum(place[rows], place[cols])
        self._band = 6 * int((self._high - self._low).max(initial=0)) + 6

    def new_blocks(self, pose_blocks: F64) -> F64:
        """(B, 6, 6) zeros, with the (F, 6, 6) blocks of the poses on the diagonal."""
        blocks = np.zeros((self.count, 6, 6))
        blocks[self._diagonal] = pose_blocks
        return blocks

    def solve(self, blocks: F64, b: F64) -> F64 | None:
        """(F, 6) step, or None where the matrix is not positive definite."""
        try:
            return self._solve_dense(blocks, b) if self.dense else self._solve_banded(blocks, b)
        except scipy.linalg.LinAlgError:
            return None

    def _solve_dense(self, blocks: F64, b: F64) -> F64 | None:
        n = self.size
        columns = blocks.reshape(n, n, 6, 6).transpose(1, 3, 0, 2).reshape(6 * n, 6 * n)  # as LAPACK has them
        _, step, failed = dposv(columns.T, b.ravel(), lower=1, overwrite_a=1)
        return None if failed else step.reshape(n, 6)

    def _solve_banded(self, blocks: F64, b: F64) -> F64:
        n, place = self.size, self._place
        band = np.zeros((6 * n, self._band))
        bundle_kernels.fill_band(blocks, self._high, self._low, self._swap, band)
        factor = scipy.linalg.cholesky_banded(band.T, overwrite_ab=True, lower=True, check_finite=False)
        right = np.empty((n, 6))
        right[place] = b
        step = scipy.linalg.cho_solve_banded((factor, True), right.ravel(), check_finite=False)
        return step.reshape(n, 6)[place]
