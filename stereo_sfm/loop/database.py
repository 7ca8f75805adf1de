"""Place database: the words of all keyframes in one table.

A query reads the whole table, a millisecond for a thousand keyframes: less than matching one of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from stereo_sfm.loop.vocabulary import Bag
from stereo_sfm.mapping.columns import Columns, column
from stereo_sfm.types import F32, F64, I32, I64


class _Words(Columns):
    """One row for each word of each keyframe: keyframe after keyframe, the words of each ascending."""

    keyframe: I32 = column(np.int32, -1)  # its row
    word: I32 = column(np.int32, -1)
    weight: F32 = column(np.float32, 0.0)


class PlaceDatabase:
    """Keyframes by their bags of words."""

    def __init__(self, word_count: int) -> None:
        self._words = _Words(1024)
        self._asked: F32 = np.zeros(word_count, np.float32)  # weight of each word in a query
        self.kf_ids: I64 = np.zeros(0, np.int64)  # (K,) in order of insertion

    def __len__(self) -> int:
        """Number of keyframes."""
        return len(self.kf_ids)

    def add(self, kf_id: int, bag: Bag) -> None:
        """Insert a keyframe."""
        self._words.append(len(bag.words), keyframe=len(self), word=bag.words, weight=bag.weights)
        self.kf_ids = np.append(self.kf_ids, kf_id)

    def keep(self, rows: I64) -> None:
        """Remove all keyframes but those in the given rows (K,), ascending, which become 0, 1, ...; scores stay."""
        renamed = np.full(len(self), -1, np.int32)
        renamed[rows] = np.arange(len(rows))
        keyframe = renamed[self._words.keyframe]
        self._words.keep(np.flatnonzero(keyframe >= 0))
        self._words.keyframe[:] = keyframe[keyframe >= 0]
        self.kf_ids = self.kf_ids[rows]

    def scores(self, bag: Bag) -> F64:
        """(K,) L1 score in [0, 1] of every keyframe in order of insertion: 1 - |a - b|_1 / 2, the common minima."""
        self._asked[bag.words] = bag.weights
        common = np.minimum(self._asked[self._words.word], self._words.weight)
        self._asked[bag.words] = 0.0
        return np.asarray(np.bincount(self._words.keyframe, common, len(self)), np.float64)


def apart(ids: Iterable[int], radius: int, most: int, chosen: Sequence[int] = ()) -> list[int]:
    """The chosen ids and the first of the others, `most` in all, that are more than `radius` from all before them."""
    out = list(chosen)
    for k in ids:
        if len(out) < most and all(abs(k - other) > radius for other in out):
            out.append(k)
    return out
