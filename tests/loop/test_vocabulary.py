"""The vocabulary tree: words of noisy views, files; and the inverted index against the plain definition."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry.hamming import as_words
from stereo_sfm.loop import vocabulary as voc
from stereo_sfm.loop.binary import _two_nearest, match_descriptors
from stereo_sfm.loop.database import PlaceDatabase
from stereo_sfm.loop.vocabulary_file import default_vocabulary, load_vocabulary, save_vocabulary
from stereo_sfm.types import U8

LOOKS = np.random.default_rng(0).integers(0, 256, (2000, 32), dtype=np.uint8)


def picture(rng: np.random.Generator, which: np.ndarray, flip: float = 0.05) -> U8:
    """Noisy descriptors of the places `which`."""
    return LOOKS[which] ^ np.packbits(rng.random((len(which), 256)) < flip, axis=1)


@pytest.fixture(scope="module")
def places() -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [rng.choice(2000, 200, replace=False) for _ in range(60)]


@pytest.fixture(scope="module")
def vocabulary(places: list[np.ndarray]) -> voc.Vocabulary:
    rng = np.random.default_rng(2)
    return voc.train([picture(rng, p) for p in places], branching=8, depth=4)


def test_words_that_are_everywhere_in_a_map_count_little_there(
    vocabulary: voc.Vocabulary, places: list[np.ndarray]
) -> None:
    rng = np.random.default_rng(8)
    lamps = np.arange(40)
    images = [picture(rng, np.concatenate([lamps, p[:100]]), 0.02) for p in places[:20]]
    known = [vocabulary.words(image)[0] for image in images]
    words = voc.counted(vocabulary, known)
    assert np.array_equal(words.centroids, vocabulary.centroids) and words.id != vocabulary.id
    everywhere, once = (words.idf[words.look_up(LOOKS[rows])] for rows in (lamps, places[0][:100]))
    assert np.median(everywhere) < 0.3 * np.median(once)
    assert (voc.counted(vocabulary, known[:1]).idf > 0).all()  # the smallest map has some weight left


def test_another_view_of_a_place_has_the_highest_score(vocabulary: voc.Vocabulary, places: list[np.ndarray]) -> None:
    rng = np.random.default_rng(3)
    database = PlaceDatabase(len(vocabulary))
    for k, place in enumerate(places):
        database.add(100 + k, vocabulary.bag(picture(rng, place)))
    for k, place in enumerate(places):
        scores = database.scores(vocabulary.bag(picture(rng, place)))
        second, best = np.argsort(scores)[-2:]
        assert database.kf_ids[best] == 100 + k
        assert scores[best] > 1.5 * scores[second]


def test_inverted_index_gives_the_scores_of_the_definition(
    vocabulary: voc.Vocabulary, places: list[np.ndarray]
) -> None:
    rng = np.random.default_rng(4)
    bags = [vocabulary.bag(picture(rng, p)) for p in places]
    database = PlaceDatabase(len(vocabulary))
    for k, bag in enumerate(bags):
        database.add(k, bag)
    query = vocabulary.bag(picture(rng, places[5]))
    dense = np.zeros((2, len(vocabulary)))
    for k, bag in enumerate(bags):
        dense[:] = 0
        dense[0, query.words], dense[1, bag.words] = query.weights, bag.weights
        assert database.scores(query)[k] == pytest.approx(1 - 0.5 * np.abs(dense[0] - dense[1]).sum(), abs=1e-6)


def test_training_twice_gives_the_same_bits(places: list[np.ndarray], vocabulary: voc.Vocabulary) -> None:
    rng = np.random.default_rng(2)
    again = voc.train([picture(rng, p) for p in places], branching=8, depth=4)
    assert again.id == vocabulary.id
    other = voc.train([picture(rng, p) for p in places], branching=8, depth=4, seed=1)
    assert other.id != vocabulary.id


def test_zero_rows_have_no_word(vocabulary: voc.Vocabulary) -> None:
    ids = vocabulary.look_up(np.zeros((3, 32), np.uint8))
    assert (ids == -1).all()
    bag = vocabulary.bag(np.zeros((3, 32), np.uint8))
    assert len(bag.words) == 0 and len(bag.weights) == 0


def test_file_round_trip(tmp_path: Path, vocabulary: voc.Vocabulary) -> None:
    save_vocabulary(vocabulary, tmp_path / "a.npz")
    save_vocabulary(vocabulary, tmp_path / "b.npz")
    assert load_vocabulary(tmp_path / "a.npz").id == vocabulary.id
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_bad_files_get_one_line(tmp_path: Path, vocabulary: voc.Vocabulary) -> None:
    path = tmp_path / "v.npz"
    with pytest.raises(StereoSfmError, match="no vocabulary at"):
        load_vocabulary(path)
    path.write_bytes(b"nonsense")
    with pytest.raises(StereoSfmError, match="not a vocabulary file or is damaged"):
        load_vocabulary(path)
    save_vocabulary(vocabulary, path)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(StereoSfmError, match="damaged"):
        load_vocabulary(path)
    np.savez_compressed(path, version=np.array(99))
    with pytest.raises(StereoSfmError, match="version 99"):
        load_vocabulary(path)


def test_matching_finds_the_true_pairs_and_the_ratio_test_ignores_views_of_one_point() -> None:
    rng = np.random.default_rng(7)
    which = np.arange(100)
    query, train = picture(rng, which), picture(rng, np.repeat(which, 2))
    q, t = match_descriptors(query, train, np.repeat(which, 2), ratio=0.8)
    assert len(q) > 95
    assert (t // 2 == q).all()
    assert len(match_descriptors(query, train, None, ratio=0.8)[0]) < 60  # each view is the other's rival


def test_the_two_nearest_are_those_of_the_whole_table() -> None:
    rng = np.random.default_rng(8)
    a, b = (picture(rng, rng.integers(0, 40, n), 0.2) for n in (90, 300))
    group = rng.integers(0, 60, 300)
    best, first, second = _two_nearest(as_words(a), as_words(b), group)
    bits = np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2, dtype=np.int64)
    assert np.array_equal(best, bits.argmin(axis=1)) and np.array_equal(first, bits.min(axis=1))
    rivals = np.where(group == group[best][:, None], 257, bits)
    assert (second <= rivals.min(axis=1)).all() and (second >= first).all()
    assert np.mean(second == rivals.min(axis=1)) > 0.9
    assert _two_nearest(as_words(a), as_words(b[:0]), group[:0])[0].max() == -1


def test_package_vocabulary_loads() -> None:
    vocabulary = default_vocabulary()
    assert len(vocabulary) > 1000
    bag = vocabulary.bag(LOOKS)
    assert float(bag.weights.sum()) == pytest.approx(1.0, abs=1e-5)
