"""Point ids, carried from view to view by matches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereo_sfm.papers.feature_view import FeatureView
from stereo_sfm.types import I64, Bool


class PointIds:
    """Hands out ids, never twice, and knows which were fused by the map."""

    def __init__(self) -> None:
        self._next = 0
        self._replaced: dict[int, int] = {}  # fused id -> the id that lives on

    def fuse(self, pairs: I64) -> None:
        """(D, 2) old id -> the id that replaces it."""
        for old, new in pairs.tolist():
            if old != new:
                self._replaced[old] = new

    def current(self, ids: I64) -> I64:
        """The living id of each."""
        out: list[int] = ids.tolist()
        for k in range(len(out)):
            while out[k] in self._replaced:
                out[k] = self._replaced[out[k]]
        return np.array(out, np.int64)

    def inherit(self, view: FeatureView, reference: FeatureView, rows: I64) -> FeatureView:
        """The view with ids of the reference for matched rows (M, 2) = (reference, view); an id is given only once."""
        ids, ages = view.ids.copy(), view.ages.copy()
        given = self.current(reference.ids[rows[:, 0]])
        _, first = np.unique(given, return_index=True)
        fresh = np.zeros(len(rows), bool)
        fresh[first] = True
        fresh &= (given >= 0) & (ids[rows[:, 1]] < 0) & ~np.isin(given, ids[ids >= 0])
        ids[rows[fresh, 1]] = given[fresh]
        ages[rows[fresh, 1]] = reference.ages[rows[fresh, 0]] + 1
        return replace(view, ids=ids, ages=ages)

    def give_new(self, view: FeatureView, only: Bool | None = None) -> FeatureView:
        """The view with a new id wherever there is none (and `only` allows it)."""
        ids = view.ids.copy()
        new = np.flatnonzero((ids < 0) if only is None else (ids < 0) & only)
        ids[new] = self._next + np.arange(len(new))
        self._next += len(new)
        return replace(view, ids=ids)
