"""Vocabulary tree over binary descriptors: train, look up (Galvez-Lopez & Tardos, T-RO 28, 2012). A word is a leaf."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from stereo_sfm.geometry.hamming import U64, as_words
from stereo_sfm.loop import binary
from stereo_sfm.types import F32, I32, I64, U8


@dataclass(frozen=True, eq=False)
class Bag:
    """A keyframe as weighted words; weights sum to one (L1)."""

    words: I32  # (W,) ascending
    weights: F32  # (W,) tf-idf


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """Tree in columns; node 0 is the root, the children of a node are consecutive."""

    centroids: U64  # (M, 4) k-majority centre of each node
    first_child: I32  # (M,)
    child_count: I32  # (M,) 0 at leaves
    word: I32  # (M,) word id of a leaf, -1 inside the tree
    idf: F32  # (W,) natural logarithm of (images / images with the word)
    id: str = field(init=False)  # changes with any bit of the content

    def __post_init__(self) -> None:
        digest = hashlib.sha256()
        for array in (self.centroids, self.first_child, self.child_count, self.word, self.idf):
            array.flags.writeable = False
            digest.update(np.ascontiguousarray(array).tobytes())
        object.__setattr__(self, "id", digest.hexdigest()[:16])

    def __len__(self) -> int:
        """Number of words."""
        return len(self.idf)

    def look_up(self, descriptors: U8) -> I32:
        """(N, 32) -> word ids (N,), -1 for zero rows."""
        node = binary.descend(as_words(descriptors), self.centroids, self.first_child, self.child_count)
        return np.where(binary.present(descriptors), self.word[node], -1).astype(np.int32)

    def words(self, descriptors: U8) -> tuple[I32, I64]:
        """(N, 32) of an image -> its words (W,), ascending, and how often it has each (W,)."""
        ids = self.look_up(descriptors)
        words, counts = np.unique(ids[ids >= 0], return_counts=True)
        return words, counts

    def bag(self, descriptors: U8) -> Bag:
        """Term frequency times inverse document frequency, scaled to sum one; empty without known words."""
        return self.weighed(*self.words(descriptors))

    def weighed(self, words: I32, counts: I64) -> Bag:
        """The bag of an image with these `words`."""
        weights = counts * self.idf[words]
        total = float(weights.sum())
        keep = weights > 0
        return Bag(words[keep].astype(np.int32), (weights[keep] / max(total, 1e-12)).astype(np.float32))


def train(images: Sequence[U8], branching: int = 10, depth: int = 4, seed: int = 0) -> Vocabulary:
    """Hierarchical k-majority clustering of all descriptors, then idf over the images.

    Args:
        images: one (N, 32) array of descriptors per image.
        branching: children of a node; depth: levels, so at most branching ** depth words.
    """
    descriptors = np.concatenate(list(images))
    words = as_words(descriptors[binary.present(descriptors)])
    if not len(words):
        raise ValueError("no descriptors to train a vocabulary from")
    rng = np.random.default_rng(seed)
    centroids, first_child, child_count = [np.zeros((1, 4), np.uint64)], [0], [0]
    level = [(0, np.arange(len(words), dtype=np.int32))]
    total = 1
    for _ in range(depth):
        following: list[tuple[int, I32]] = []
        for node, members in level:
            if len(members) < 2:
                continue
            centres, assignment = binary.k_majority(words, members, branching, rng)
            if len(centres) < 2:
                continue
            first_child[node], child_count[node] = total, len(centres)
            centroids.append(centres)
            first_child += [0] * len(centres)
            child_count += [0] * len(centres)
            following += [(total + c, members[assignment == c]) for c in range(len(centres))]
            total += len(centres)
        level = following
    counts = np.array(child_count, np.int32)
    leaves = np.flatnonzero(counts == 0)
    word = np.full(total, -1, np.int32)
    word[leaves] = np.arange(len(leaves), dtype=np.int32)
    tree = Vocabulary(
        np.concatenate(centroids), np.array(first_child, np.int32), counts, word, np.ones(len(leaves), np.float32)
    )
    seen = _images_with(len(tree), [tree.words(descriptors)[0] for descriptors in images])
    idf = np.log(np.maximum(len(images), 2) / np.maximum(seen, 1)).astype(np.float32)
    return dataclasses.replace(tree, idf=idf)


def _images_with(count: int, images: Sequence[I32]) -> I64:
    """(W,) in how many images each of `count` words is; of each image its words."""
    seen = np.zeros(count, np.int64)
    for words in images:
        seen[words] += 1
    return seen


def counted(vocabulary: Vocabulary, images: Sequence[I32]) -> Vocabulary:
    """The same words with the idf of other images: of a map, where lamps and floor tiles are everywhere.

    Words of all images keep a little weight, so that the smallest map has some.

    Args:
        images: the `words` of each.
    """
    seen = _images_with(len(vocabulary), images)
    return dataclasses.replace(vocabulary, idf=np.log((len(images) + 1) / np.maximum(seen, 1)).astype(np.float32))
