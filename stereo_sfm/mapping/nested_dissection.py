"""Nested dissection: in which order keyframes are eliminated, and which of them each elimination couples.

Keyframes that see the same points are neighbours in a graph. A set of keyframes whose removal leaves two unconnected
parts (a separator) is eliminated after both parts, which then do not fill in each other; the parts are divided likewise
(George, SIAM J. Numer. Anal. 10, 1973). So the work grows little faster than the map, loops, aisles and revisits
included, where the width of a band grows with every loop. Separators are within one level of a breadth-first search.
"""

# pyright: reportOptionalSubscript=false

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components, dijkstra

from stereo_sfm.types import I64

LEAF = 40  # keyframes that are not divided any further: large enough for LAPACK
BALANCE = 0.2  # share of the nodes that either part should have at least, so that the depth stays logarithmic
SWEEPS = 3  # searches for a node at the border of the graph, each from the farthest node of the one before


@dataclass(frozen=True, eq=False)
class Front:
    """A set of nodes that are eliminated together."""

    own: I64  # (S,) nodes that are eliminated
    others: I64  # (T,) later ones, in order of elimination, that they and what was eliminated before are coupled with
    parent: int  # the front to which the others are handed on, -1: none


def fronts_of(graph: scipy.sparse.csr_array) -> list[Front]:
    """All fronts in order of elimination: each after those whose parent it is.

    Args:
        graph: (n, n) symmetric pattern, with its diagonal.
    """
    parts = _dissect(graph, np.arange(graph.shape[0]))
    nodes = np.concatenate([np.zeros(0, np.int64), *parts])
    place = np.empty(len(nodes), np.int64)
    place[nodes] = np.arange(len(nodes))
    part_of = np.repeat(np.arange(len(parts)), [len(part) for part in parts])  # by place
    coupled: list[list[I64]] = [[] for _ in parts]
    fronts: list[Front] = []
    for k, own in enumerate(parts):
        later = np.unique(np.concatenate([place[graph[own].indices], *coupled[k]]))
        later = later[part_of[later] > k]
        parent = int(part_of[later[0]]) if len(later) else -1
        if parent >= 0:
            coupled[parent].append(later)
        fronts.append(Front(own, nodes[later], parent))
    return fronts


def _dissect(graph: scipy.sparse.csr_array, nodes: I64) -> list[I64]:
    """Parts of the nodes, every separator after what it separates."""
    if len(nodes) <= LEAF:
        return [nodes] if len(nodes) else []
    inner = graph[nodes][:, nodes]
    count, component = connected_components(inner, directed=False)
    if count > 1:
        return [part for c in range(count) for part in _dissect(graph, nodes[component == c])]
    level = _levels(inner)
    highest = np.maximum.reduceat(level[inner.indices], inner.indptr[:-1])  # of the neighbours of each node
    border = highest > level
    sizes, before = np.bincount(level[border], minlength=level.max() + 1), np.cumsum(np.bincount(level))
    before -= sizes
    smaller = np.minimum(before, len(nodes) - before - sizes)
    worth = smaller / np.maximum(sizes, 1)
    middle = int(np.argmax(np.where(smaller >= BALANCE * len(nodes), worth, worth - len(nodes))))
    if smaller[middle] < 1:
        return [nodes]
    separator = border & (level == middle)
    first = (level <= middle) & ~separator
    return [
        *_dissect(graph, nodes[first]),
        *_dissect(graph, nodes[level > middle]),
        nodes[separator],
    ]


def _levels(graph: scipy.sparse.csr_array) -> I64:
    """(n,) steps from a node at the border of a connected graph."""
    level = np.zeros(graph.shape[0])
    for _ in range(SWEEPS):
        level = np.asarray(dijkstra(graph, directed=False, unweighted=True, indices=int(np.argmax(level))))
    return level.astype(np.int64)
