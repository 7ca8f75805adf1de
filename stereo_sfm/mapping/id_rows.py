"""Rows of a table by id, for ids that are known for a while and then forgotten."""

from __future__ import annotations

import numpy as np

from stereo_sfm.types import I32, I64, Bool


class IdRows:
    """Which row each known id has. Its size follows the number of known ids, not the highest of them."""

    def __init__(self) -> None:
        self.ids: I64 = np.zeros(0, np.int64)  # ascending
        self.rows: I32 = np.zeros(0, np.int32)  # of each of them; may be written to

    def __len__(self) -> int:
        return len(self.ids)

    def find(self, ids: I64) -> I64:
        """(N,) row of each id, -1 for an unknown one."""
        if not len(self.ids):
            return np.full(len(ids), -1, np.int64)
        at = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return np.where(self.ids[at] == ids, self.rows[at], -1).astype(np.int64)

    def add(self, ids: I64, rows: I64) -> None:
        """Add unknown ids (N,), each of them once, with their rows (N,)."""
        order = np.argsort(ids)
        at = np.searchsorted(self.ids, ids[order])
        self.ids, self.rows = np.insert(self.ids, at, ids[order]), np.insert(self.rows, at, rows[order])

    def keep(self, known: Bool) -> None:
        """Forget all ids but those marked (N,)."""
        self.ids, self.rows = self.ids[known], self.rows[known]

    @property
    def nbytes(self) -> int:
        """Bytes of both arrays."""
        return self.ids.nbytes + self.rows.nbytes
