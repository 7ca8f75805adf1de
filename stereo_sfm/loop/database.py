"""Place database: an inverted index from words to keyframes, in arrays that grow by doubling.

Postings of a word are a chain of blocks, so adding a keyframe never moves the others and a query reads only the
postings of its words.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

from typing import Any

import numpy as np

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.loop.vocabulary import Bag
from stereo_sfm.types import F32, F64, I32, I64

BLOCK = 16  # postings; a word that few keyframes have takes one block


@njit
def _insert(words, weights, entry, head, fill, following, block_entry, block_weight, used):
    """Append (entry, weight) to the chain of each word; newest block first. Returns the number of used blocks."""
    for i in range(words.shape[0]):
        w = words[i]
        block = head[w]
        if block < 0 or fill[block] == BLOCK:
            following[used] = block
            head[w] = used
            block = used
            used += 1
        slot = fill[block]
        block_entry[block, slot] = entry
        block_weight[block, slot] = weights[i]
        fill[block] = slot + 1
    return used


@njit
def _accumulate(words, weights, head, fill, following, block_entry, block_weight, scores):
    """Add the common minimum of every posting to its entry's score (words in ascending order: a fixed sum order)."""
    for i in range(words.shape[0]):
        block = head[words[i]]
        while block >= 0:
            for s in range(fill[block]):
                scores[block_entry[block, s]] += min(weights[i], block_weight[block, s])
            block = following[block]


@njit
def _copy_kept(
    head, fill, following, block_entry, block_weight, renamed, to_head, to_fill, to_following, to_entry, to_weight
):
    """The postings of entries that have a new name (not -1), into empty chains. Returns the number of used blocks."""
    used = 0
    for w in range(head.shape[0]):
        block = head[w]
        while block >= 0:
            for s in range(fill[block]):
                entry = renamed[block_entry[block, s]]
                if entry >= 0:
                    target = to_head[w]
                    if target < 0 or to_fill[target] == BLOCK:
                        to_following[used] = target
                        to_head[w] = used
                        target = used
                        used += 1
                    to_entry[target, to_fill[target]] = entry
                    to_weight[target, to_fill[target]] = block_weight[block, s]
                    to_fill[target] += 1
            block = following[block]
    return used


def _grown(array: Any, size: int, value: int = 0) -> Any:
    """A copy with at least `size` rows, doubling."""
    if len(array) >= size:
        return array
    out = np.full((max(size, 2 * len(array)), *array.shape[1:]), value, array.dtype)
    out[: len(array)] = array
    return out


class PlaceDatabase:
    """Keyframes by their bags of words."""

    def __init__(self, word_count: int) -> None:
        self._head: I32 = np.full(word_count, -1, np.int32)
        self._fill: I32 = np.zeros(1024, np.int32)
        self._following: I32 = np.full(1024, -1, np.int32)
        self._entry: I32 = np.zeros((1024, BLOCK), np.int32)
        self._weight: F32 = np.zeros((1024, BLOCK), np.float32)
        self._used = 0
        self._kf_ids: I64 = np.zeros(64, np.int64)
        self._count = 0

    def __len__(self) -> int:
        """Number of keyframes."""
        return self._count

    @property
    def kf_ids(self) -> I64:
        """(K,) in order of insertion."""
        return self._kf_ids[: self._count]

    def add(self, kf_id: int, bag: Bag) -> None:
        """Insert a keyframe; new words of a grown vocabulary are added."""
        if len(bag.words):
            self._head = _grown(self._head, int(bag.words[-1]) + 1, -1)
        self._reserve(self._used + len(bag.words))
        self._used = _insert(
            bag.words,
            bag.weights,
            self._count,
            self._head,
            self._fill,
            self._following,
            self._entry,
            self._weight,
            self._used,
        )
        self._kf_ids = _grown(self._kf_ids, self._count + 1)
        self._kf_ids[self._count] = kf_id
        self._count += 1

    def keep(self, rows: I64) -> None:
        """Remove all keyframes but those in the given rows (K,), ascending, which become 0, 1, ...; scores stay."""
        kf_ids = self.kf_ids[rows]
        renamed = np.full(self._count, -1, np.int64)
        renamed[rows] = np.arange(len(rows))
        to = PlaceDatabase(len(self._head))
        to._reserve(self._used)
        to._used = _copy_kept(
            self._head, self._fill, self._following, self._entry, self._weight, renamed,
            to._head, to._fill, to._following, to._entry, to._weight,
        )  # fmt: skip
        to._kf_ids, to._count = np.append(kf_ids, np.zeros(64, np.int64)), len(rows)
        to._trim()
        self.__dict__ = to.__dict__

    def _reserve(self, blocks: int) -> None:
        """Allocate at least so many blocks."""
        self._fill, self._following = _grown(self._fill, blocks), _grown(self._following, blocks, -1)
        self._entry, self._weight = _grown(self._entry, blocks), _grown(self._weight, blocks)

    def _trim(self) -> None:
        """Free unused blocks."""
        self._fill, self._following = self._fill[: self._used].copy(), self._following[: self._used].copy()
        self._entry, self._weight = self._entry[: self._used].copy(), self._weight[: self._used].copy()

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        arrays = (self._head, self._fill, self._following, self._entry, self._weight, self._kf_ids)
        return sum(array.nbytes for array in arrays)

    def scores(self, bag: Bag) -> F64:
        """(K,) L1 score of every keyframe in order of insertion (see `vocabulary.score`)."""
        scores = np.zeros(self._count)
        known = bag.words < len(self._head)
        _accumulate(
            bag.words[known],
            bag.weights[known],
            self._head,
            self._fill,
            self._following,
            self._entry,
            self._weight,
            scores,
        )
        return scores

    def query(self, bag: Bag, min_score: float, limit: int) -> tuple[I64, F64]:
        """Keyframes that score above `min_score`, best first, ties to the older; at most `limit`."""
        scores = self.scores(bag)
        chosen = np.flatnonzero(scores > min_score)
        order = chosen[np.lexsort((chosen, -scores[chosen]))][:limit]
        return self.kf_ids[order], scores[order]
