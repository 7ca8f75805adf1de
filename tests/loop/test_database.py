"""Removing keyframes frees memory and changes no score."""

from __future__ import annotations

import pickle

import numpy as np

from stereo_sfm.loop.database import PlaceDatabase
from stereo_sfm.loop.vocabulary import Bag

WORDS = 2000


def bags(count: int) -> list[Bag]:
    rng = np.random.default_rng(3)
    out: list[Bag] = []
    for _ in range(count):
        words = np.unique(rng.integers(0, WORDS, 300)).astype(np.int32)
        weights = rng.uniform(0.1, 1.0, len(words)).astype(np.float32)
        out.append(Bag(words, weights / weights.sum()))
    return out


def test_scores_of_remaining_keyframes_keep_their_bits() -> None:
    made = bags(60)
    database, small = PlaceDatabase(WORDS), PlaceDatabase(WORDS)
    kept = np.array([0, 3, 4, 17, 18, 40])
    for k, bag in enumerate(made[:50]):
        database.add(100 + k, bag)
        if k in kept:
            small.add(100 + k, bag)
    before = database.scores(made[55])
    database.keep(kept)
    assert database.kf_ids.tolist() == (100 + kept).tolist() == small.kf_ids.tolist()
    for k, bag in enumerate(made[50:]):
        database.add(200 + k, bag)
        small.add(200 + k, bag)
    assert (database.scores(made[55])[:6] == before[kept]).all()
    assert (database.scores(made[55]) == small.scores(made[55])).all()


def test_memory_does_not_grow_in_a_known_place() -> None:
    database, sizes = PlaceDatabase(WORDS), list[int]()
    for k, bag in enumerate(bags(1500)):
        database.add(k, bag)
        if len(database) > 100:
            database.keep(np.arange(50, len(database)))
            sizes.append(len(pickle.dumps(database._words)))
    assert max(sizes[-5:]) <= 1.1 * max(sizes[:5])
