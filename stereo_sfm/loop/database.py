"""Place database: an inverted index from words to keyframes, in arrays that grow by doubling.

Postings of a word are a linked list of blocks, so adding a keyframe never moves the others and a query reads only the
postings of its words.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.loop.vocabulary import Bag
from stereo_sfm.types import F32, F64, I32, I64

BLOCK = 16  # postings; a word that few keyframes have takes one block


class Postings(NamedTuple):
    """The linked lists of blocks of all words."""

    head: I32  # (W,) newest block of each word, -1: none
    fill: I32  # (B,) postings in each block
    following: I32  # (B,) next older block of the same word, -1: last
    entry: I32  # (B, BLOCK)
    weight: F32  # (B, BLOCK)


@njit
def _insert(words, weights, entry, to, used):
    """Append (entry, weight) to the list of each word; newest block first. Returns the number of used blocks."""
    for i in range(words.shape[0]):
        w = words[i]
        block = to.head[w]
        if block < 0 or to.fill[block] == BLOCK:
            to.following[used] = block
            to.head[w] = used
            block = used
            used += 1
        slot = to.fill[block]
        to.entry[block, slot] = entry
        to.weight[block, slot] = weights[i]
        to.fill[block] = slot + 1
    return used


@njit
def _accumulate(words, weights, postings, scores):
    """Add the common minimum of every posting to its entry's score (words in ascending order: a fixed sum order)."""
    for i in range(words.shape[0]):
        block = postings.head[words[i]]
        while block >= 0:
            for s in range(postings.fill[block]):
                scores[postings.entry[block, s]] += min(weights[i], postings.weight[block, s])
            block = postings.following[block]


@njit
def _copy_kept(postings, renamed, to):
    """The postings of entries that have a new name (not -1), into empty lists. Returns the number of used blocks."""
    used = 0
    word, weight = np.empty(1, np.int32), np.empty(1, np.float32)
    for w in range(postings.head.shape[0]):
        block = postings.head[w]
        while block >= 0:
            for s in range(postings.fill[block]):
                entry = renamed[postings.entry[block, s]]
                if entry >= 0:
                    word[0], weight[0] = w, postings.weight[block, s]
                    used = _insert(word, weight, entry, to, used)
            block = postings.following[block]
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
        self._postings = Postings(
            np.full(word_count, -1, np.int32),
            np.zeros(1024, np.int32),
            np.full(1024, -1, np.int32),
            np.zeros((1024, BLOCK), np.int32),
            np.zeros((1024, BLOCK), np.float32),
        )
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
        """Insert a keyframe."""
        self._reserve(self._used + len(bag.words))
        self._used = _insert(bag.words, bag.weights, self._count, self._postings, self._used)
        self._kf_ids = _grown(self._kf_ids, self._count + 1)
        self._kf_ids[self._count] = kf_id
        self._count += 1

    def keep(self, rows: I64) -> None:
        """Remove all keyframes but those in the given rows (K,), ascending, which become 0, 1, ...; scores stay."""
        renamed = np.full(self._count, -1, np.int64)
        renamed[rows] = np.arange(len(rows))
        to = PlaceDatabase(len(self._postings.head))
        to._reserve(self._used)
        to._used = used = _copy_kept(self._postings, renamed, to._postings)
        to._kf_ids, to._count = np.append(self.kf_ids[rows], np.zeros(64, np.int64)), len(rows)
        head, *blocks = to._postings
        to._postings = Postings._make((head, *(column[:used].copy() for column in blocks)))
        self.__dict__ = to.__dict__

    def _reserve(self, blocks: int) -> None:
        """Allocate at least so many blocks."""
        head, fill, following, entry, weight = self._postings
        following = _grown(following, blocks, -1)
        self._postings = Postings(head, _grown(fill, blocks), following, _grown(entry, blocks), _grown(weight, blocks))

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(array.nbytes for array in (*self._postings, self._kf_ids))

    def scores(self, bag: Bag) -> F64:
        """(K,) L1 score in [0, 1] of every keyframe in order of insertion: 1 - |a - b|_1 / 2, the common minima."""
        scores = np.zeros(self._count)
        _accumulate(bag.words, bag.weights, self._postings, scores)
        return scores
