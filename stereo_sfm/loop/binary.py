"""256-bit binary descriptors: nearest neighbours, k-majority clustering.

A row of zeros means that no descriptor could be computed and matches nothing.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry.hamming import BITS, U64, as_words, hamming, hamming_to_all
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.types import I32, I64, U8, Bool


def present(descriptors: U8) -> Bool:
    """(N, 32) -> (N,) False for the zero rows."""
    return np.asarray(np.any(descriptors, axis=1), bool)


@njit
def _two_nearest(a, b, group):
    """For every row of a: nearest row of b, its distance, and the distance of the nearest row of another group.

    `group` (len(b),) marks rows that show one physical point: they do not compete with each other. Ties go to the
    lower index.
    """
    best = np.full(a.shape[0], -1, np.int32)
    first = np.full(a.shape[0], BITS + 1, np.int32)
    second = np.full(a.shape[0], BITS + 1, np.int32)
    columns, distances = np.ascontiguousarray(b.T), np.empty(b.shape[0], np.int16)
    for i in range(a.shape[0]):
        hamming_to_all(a, i, columns, distances)
        at, low, rival = -1, BITS + 1, BITS + 1
        for j in range(b.shape[0]):
            d = distances[j]
            if d >= rival:
                continue
            if d < low:
                if at >= 0 and group[at] != group[j]:
                    rival = low
                low, at = d, j
            elif group[j] != group[at]:
                rival = d
        best[i], first[i], second[i] = at, low, rival
    return best, first, second


def _distances(words: U64, centres: U64) -> I64:
    """(N, 4) and (k, 4) -> (k, N) differing bits."""
    return np.array([np.bitwise_count(words ^ centre).sum(1, dtype=np.int64) for centre in centres])


def _majorities(words: U64, assignment: I64) -> U64:
    """(c, 4) bitwise majority of each cluster of rows of words (N, 4) that has any; a tie gives zero."""
    bits = [np.unpackbits(words[assignment == c].view(np.uint8), axis=1) for c in np.unique(assignment)]
    return as_words(np.array([np.packbits(2 * b.sum(0, dtype=np.int64) > len(b)) for b in bits]))


@njit
def descend(words, centroids, first_child, child_count):
    """Leaf node reached by every descriptor."""
    node = np.zeros(words.shape[0], np.int32)
    for i in range(words.shape[0]):
        at = 0
        while child_count[at] > 0:
            low = BITS + 1
            start = first_child[at]
            for c in range(start, start + child_count[at]):
                d = hamming(words, i, centroids, c)
                if d < low:
                    low = d
                    at = c
        node[i] = at
    return node


def k_majority(words: U64, members: I32, k: int, rng: np.random.Generator, rounds: int = 10) -> tuple[U64, I32]:
    """k-majority clustering (Grana et al., 2013: k-means with Hamming distance and bitwise majority).

    Args:
        words: (N, 4). members: (n,) rows to cluster.
        k: clusters wanted; fewer come back when there are fewer distinct descriptors.

    Returns:
        (c, 4) centres and (n,) the centre of each member.
    """
    words = words[members]
    centres = words[[int(rng.integers(len(words)))]]
    distance = _distances(words, centres)[0]
    while len(centres) < k:  # k-means++ seeding: the next centre with probability proportional to squared distance
        weight = distance.astype(float) ** 2
        total = weight.sum()
        if total == 0:
            break
        pick = int(np.searchsorted(np.cumsum(weight), rng.random() * total, side="right"))
        new = words[[min(pick, len(words) - 1)]]
        centres = np.concatenate([centres, new])
        distance = np.minimum(distance, _distances(words, new)[0])
    assignment = _distances(words, centres).argmin(0)  # ties go to the lower centre
    for _ in range(rounds):
        centres = _majorities(words, assignment)
        updated = _distances(words, centres).argmin(0)
        if np.array_equal(updated, assignment):
            break
        assignment = updated
    used, assignment = np.unique(assignment, return_inverse=True)
    return centres[used], assignment.astype(np.int32)


def match_descriptors(
    query: U8, train: U8, group: I64 | None = None, max_distance: int = 64, ratio: float = 1.0
) -> tuple[I32, I32]:
    """Pairs of mutually nearest descriptors.

    Args:
        query: (N, 32). train: (M, 32).
        group: (M,) rows of train with the same value are one physical point and do not compete in the ratio test.
        max_distance: bits; ratio: nearest / nearest of another point must not exceed it (1: no test).

    Returns:
        Query rows, train rows: (K,) each, ascending in the query row.
    """
    q_rows, t_rows = np.flatnonzero(present(query)).astype(np.int32), np.flatnonzero(present(train)).astype(np.int32)
    a, b = as_words(query[q_rows]), as_words(train[t_rows])
    groups = np.arange(len(b)) if group is None else np.ascontiguousarray(group[t_rows])
    best, first, second = _two_nearest(a, b, groups)
    ok = (best >= 0) & (first <= max_distance) & (first <= ratio * second)
    if ok.any():
        queried, back_row = np.unique(best[ok], return_inverse=True)
        back, _, _ = _two_nearest(b[queried], a, np.arange(len(a)))
        ok[ok] = back[back_row] == np.flatnonzero(ok)
    return q_rows[ok], t_rows[best[ok]]
