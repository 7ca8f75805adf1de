"""How many points two keyframes share: a symmetric sparse count matrix that grows by rows."""

from __future__ import annotations

import numpy as np
import scipy.sparse

from stereo_sfm.types import I64


class Covisibility:
    """Counts by keyframe row. Cost of a change depends on the neighbours it touches, never on the size."""

    def __init__(self) -> None:
        self._rows: list[dict[int, int]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def grow(self, size: int) -> None:
        """At least `size` rows."""
        self._rows.extend({} for _ in range(size - len(self._rows)))

    def add(self, first: I64, second: I64, change: int = 1) -> None:
        """Add `change` for every pair of keyframes (first[i], second[i]); counts at zero vanish."""
        apart = first != second
        if not apart.any():
            return
        size = len(self._rows)
        keys, counts = np.unique(first[apart] * size + second[apart], return_counts=True)
        for a, b, n in zip((keys // size).tolist(), (keys % size).tolist(), (counts * change).tolist(), strict=True):
            for x, y in ((a, b), (b, a)):
                total = self._rows[x].get(y, 0) + n
                if total > 0:
                    self._rows[x][y] = total
                else:
                    self._rows[x].pop(y, None)

    def join(self, row: int, counts: I64) -> None:
        """A keyframe shares counts (K,) more points with the others."""
        others = np.flatnonzero(counts)
        mine = self._rows[row]
        for other, n in zip(others.tolist(), counts[others].tolist(), strict=True):
            if other != row:
                mine[other] = self._rows[other][row] = mine.get(other, 0) + n

    def drop(self, row: int) -> None:
        """A keyframe that is gone shares nothing."""
        for other in self._rows[row]:
            self._rows[other].pop(row, None)
        self._rows[row].clear()

    def neighbours(self, row: int, at_least: int = 1) -> tuple[I64, I64]:
        """(N,) keyframe rows and (N,) counts, most shared first, ties to the older."""
        shared = self._rows[row]
        rows, counts = np.fromiter(shared, np.int64, len(shared)), np.fromiter(shared.values(), np.int64, len(shared))
        rows, counts = rows[counts >= at_least], counts[counts >= at_least]
        order = np.lexsort((rows, -counts))
        return rows[order], counts[order]

    def matrix(self) -> scipy.sparse.csr_array:
        """(K, K) counts, both triangles, zero diagonal."""
        cells = [(a, b, n) for a, row in enumerate(self._rows) for b, n in sorted(row.items())]
        table = np.array(cells, np.int64).reshape(-1, 3)
        size = len(self._rows)
        return scipy.sparse.csr_array((table[:, 2], (table[:, 0], table[:, 1])), shape=(size, size))
